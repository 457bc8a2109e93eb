"""KITTI's layouts: odometry roots, raw drives, calibration and GPS/INS."""
