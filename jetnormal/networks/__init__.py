"""The networks, their configurations, and model files."""
