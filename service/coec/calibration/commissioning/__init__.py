"""A rig's own baseline and limits, and how they are learned."""
