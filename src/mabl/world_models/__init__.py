"""World models: one small file each, whose lines map onto the paper's equations."""
