"""A result drawn over the pictures that it was made from."""
