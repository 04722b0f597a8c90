"""One folder per outside thing. Only here are wire models and foreign formats translated to and from values."""
