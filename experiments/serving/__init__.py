"""What `serve.py` is made of: a line protocol, a server, and what it simulates."""
