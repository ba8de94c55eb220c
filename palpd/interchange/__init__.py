"""What other people record, read: one module a kind of file, and the steps that make a recording of it."""
