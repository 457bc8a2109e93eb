"""Files of other programs: g2o, COLMAP, PLY; what cannot be written is a ``SlamError`` of one line."""
