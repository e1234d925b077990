"""Protocols: commands, disturbances and ground over time, measures, and claims on figures (``conf/protocol``)."""
