"""What is seen in a video: one person tracked, landmarks, hands, masks, the camera stabilised."""
