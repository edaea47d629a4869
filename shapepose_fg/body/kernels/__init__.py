"""What is compiled: bodies row by row, and their normal equations."""
