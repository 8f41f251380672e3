"""A pair of images of different sizes, for the tests of the report."""


def pictures_of(make_image, dim, channels=1):
    shape = (20, 26, 31)[-dim:]
    kind = "uint8" if channels > 1 else "float32"
    fixed = make_image(shape, (2.0, 1.0, 0.5)[-dim:], channels=channels, pixel_type=kind, tilted=dim == 3)
    moving = make_image(tuple(n - 3 for n in shape), (2.0, 1.1, 0.6)[-dim:], channels=channels, pixel_type=kind)
    return fixed, moving
