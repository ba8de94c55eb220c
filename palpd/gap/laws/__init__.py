"""The search for a law that no listed effect is."""
