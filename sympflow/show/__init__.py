"""Objects to look at: cards as text and HTML, and figures."""
