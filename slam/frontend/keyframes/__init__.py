"""The front end by keyframes: corners that live across frames, a local map of points, bundle adjustment."""
