"""A law, an ageing law and an interface joined to a system; its equations, and what follows by algebra."""
