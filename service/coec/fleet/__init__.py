"""Many windows on an existing engine: jobs in, tables out."""
