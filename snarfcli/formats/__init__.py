"""Foreign files, read into plain structures without executing anything in them."""
