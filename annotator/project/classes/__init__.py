"""Classes and attributes of a project: their schema, their changes, and the values of labels and frames."""
