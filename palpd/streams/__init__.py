"""Live data in other tools: what the service does and what its loop sees, for Foxglove, Prometheus and other programs. Reads only."""
