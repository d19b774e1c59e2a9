"""The systems of the papers behind one interface, and the avatar that a user keeps."""
