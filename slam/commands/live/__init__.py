"""The system while frames arrive: a camera, a stream or a folder being filled."""
