"""What people have, turned into captures: data sets, videos with body poses, body models."""
