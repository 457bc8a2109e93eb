"""Front end: relative-pose factors and a metric scale from networks and images."""
