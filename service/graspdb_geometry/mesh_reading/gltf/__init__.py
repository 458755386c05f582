"""glTF 2.0 binary (GLB), read and written."""
