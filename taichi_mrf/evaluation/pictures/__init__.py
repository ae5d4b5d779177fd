"""Pictures of maps and of their scores."""
