"""Depth of one image from many neighbours at the poses of the SLAM system: by flow alone, or learned depth refined."""
