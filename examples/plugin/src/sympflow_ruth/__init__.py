"""Ruth's third-order symplectic method, and the Morse oscillator, as a plug-in of sympflow."""
