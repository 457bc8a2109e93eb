"""Labels: depth of one image from many neighbours at the poses of the SLAM system."""
