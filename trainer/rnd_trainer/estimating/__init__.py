"""Body poses, masks, cameras and bodies estimated from a video of one person."""
