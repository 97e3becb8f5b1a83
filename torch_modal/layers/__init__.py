"""The layers that users build models from."""
