"""What is in a data set: numbers, and a page that shows them."""
