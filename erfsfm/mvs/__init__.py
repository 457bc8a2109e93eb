"""Multi-view stereo without torch: optical flow between neighbours, and learned depth refined by a sweep."""
