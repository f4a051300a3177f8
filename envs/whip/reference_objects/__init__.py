"""FEM reference objects: soft bodies of finite elements in place of real DLOs, with none of inference's physics."""
