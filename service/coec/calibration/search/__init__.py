"""How the objective is maximised: near a start, within tens of degrees; and what a window cannot determine."""
