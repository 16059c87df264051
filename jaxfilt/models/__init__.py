"""Models of robots and their sensors, one file a domain."""
