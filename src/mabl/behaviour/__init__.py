"""How agents act and learn to act (section 3.3)."""
