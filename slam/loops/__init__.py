"""Loop closure: places seen before, found by their words, measured against depth, checked against each other."""
