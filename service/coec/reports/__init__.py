"""Everything that a person looks at: tables, plots, pages."""
