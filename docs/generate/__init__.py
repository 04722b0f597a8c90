"""What writes pages of the documentation from the tables that the code runs on: `python -m generate docs`."""
