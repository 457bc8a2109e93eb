"""Whose the data sets are, and on what terms."""

from __future__ import annotations

KITTI = """KITTI odometry: A. Geiger, P. Lenz, C. Stiller, R. Urtasun; Karlsruhe Institute of Technology and Toyota
Technological Institute at Chicago. Licence: Creative Commons Attribution-NonCommercial-ShareAlike 3.0
(https://creativecommons.org/licenses/by-nc-sa/3.0/): name the authors, not for commercial purposes, share what
you derive under the same licence. Terms: https://www.cvlibs.net/datasets/kitti/
Cite: A. Geiger, P. Lenz, R. Urtasun: Are we ready for Autonomous Driving? CVPR 2012."""

TUM = """TUM RGB-D: J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers; Technical University of Munich.
Licence: Creative Commons Attribution 4.0 (https://creativecommons.org/licenses/by/4.0/): name the authors.
Terms: https://cvg.cit.tum.de/data/datasets/rgbd-dataset
Cite: J. Sturm et al.: A Benchmark for the Evaluation of RGB-D SLAM Systems. IROS 2012."""
