"""How each system is evaluated: compositions of data, systems and metrics."""
