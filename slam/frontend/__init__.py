"""From the networks and the images to relative-pose factors and a metric scale."""
