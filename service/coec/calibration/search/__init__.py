"""How it is maximised: near a start, within tens of degrees, and what cannot be told."""
