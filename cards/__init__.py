"""Cards: what a published dataset, split or run says of itself, and how it is published."""
