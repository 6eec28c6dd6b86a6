"""Training and figures of the lifter that rnd_trainer.estimating ships."""
