"""The search for laws and events that no listed effect explains."""
