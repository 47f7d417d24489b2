"""Texts of compiled loops. They are pasted after generated code and compiled with it, and imported by nothing.

A text says at its top which functions and constants the code before it must define.
"""
