"""What the pairs of one vehicle say together: in one order, by one thread."""
