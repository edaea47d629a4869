"""Pictures, pages and viewers of a result."""
