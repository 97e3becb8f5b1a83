"""One connectivity for shapes that come with their own: a template is laid onto a target (extra ``register``)."""
