"""The daemon: palpation of soft tissue with a force one can believe."""
