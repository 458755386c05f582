"""Files that people have: trials and poses, meshes."""
