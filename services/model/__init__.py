"""The model service: four loops on the newest sample."""
