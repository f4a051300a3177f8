"""What a camera sees of a whipping scene: projection, segmentation images, and keypoints."""
