"""The learned model: networks with a memory, features and statistics around them."""
