"""Cards: what a published dataset, buffer set or run says of itself, and how it is published."""
