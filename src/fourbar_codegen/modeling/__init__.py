"""What users model: a System with its parameters, inputs and outputs, read from SymPy's mechanics objects."""
