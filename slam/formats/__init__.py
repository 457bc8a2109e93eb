"""Files of other programs: g2o, COLMAP, PLY, poses; what cannot be written is a ``SlamError`` of one line."""
