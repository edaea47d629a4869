"""A reconstruction on its way: solved windows that are kept, where it can go on, and the result made of them."""
