"""Judges many windows again on an existing engine: jobs in, tables out."""
