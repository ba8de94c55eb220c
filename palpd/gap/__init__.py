"""Where measurement and simulation part, which effect explains it, how far the gap closes."""
