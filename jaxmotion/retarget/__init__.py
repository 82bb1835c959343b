"""Motion of one skeleton on another: whose joints are whose, and how they move."""
