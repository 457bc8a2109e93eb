"""Two-view geometry of the training images, as a teacher without labels."""
