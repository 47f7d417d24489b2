"""The flows that ship: one recipe each, and the figures by which they are chosen."""
