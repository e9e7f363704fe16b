"""Networks: written for one example, without batch or agent axes; callers vmap."""
