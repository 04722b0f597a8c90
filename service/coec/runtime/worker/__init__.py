"""The process that infers and solves, and whoever looks after it."""
