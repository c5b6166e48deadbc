"""Pure functions on arrays: transforms, projection, normals, oriented boxes, overlap."""
