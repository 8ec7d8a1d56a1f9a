"""Point layouts: the fields of a published cloud."""
