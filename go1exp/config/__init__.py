"""Configuration: schema, composition, choices."""
