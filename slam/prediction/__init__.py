"""Who answers for depth and snippet poses: the networks, a cache before them, or an oracle."""
