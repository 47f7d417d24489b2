"""Ruth's third-order symplectic method as a plug-in of sympflow."""
