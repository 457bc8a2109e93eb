"""How much of an image each network sees: the paper's figure 4, measured."""
