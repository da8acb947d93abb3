"""What a camera sees of a compiled model: triangles, the rays that meet them, and their colours."""
