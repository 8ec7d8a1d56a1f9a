"""Sockets, serial lines and the thread that runs a driver on them."""
