"""Files of other programs: COLMAP, PLY, poses; what cannot be written is a ``SlamError`` of one line."""
