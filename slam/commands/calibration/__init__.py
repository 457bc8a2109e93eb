"""Calibration of a camera from images of a chessboard or a ChArUco board, through OpenCV."""
