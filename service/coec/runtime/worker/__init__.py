"""The process that infers and solves, and the supervisor that watches it."""
