"""KITTI's own layouts: odometry roots, raw drives, calibration and GPS/INS."""
