"""Decisions about a pair: what each answer changes, in order, and the books in which that is written down."""
