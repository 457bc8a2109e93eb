"""Files of other programs: g2o, COLMAP, PLY."""
