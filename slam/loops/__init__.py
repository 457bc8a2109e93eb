"""Loop closure: retrieval by binary words, verification against learned depth, consistency among loops."""
