"""What the networks see: measured, drawn, and the street that is looked at."""
