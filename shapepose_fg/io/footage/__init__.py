"""Videos and folders of pictures, one for each camera."""
