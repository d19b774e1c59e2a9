"""The systems of the papers behind one interface, and the trained field that is saved and queried."""
