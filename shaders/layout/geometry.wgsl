// Sizes of a kernel's tensors, which stand in front of every kernel of a network's layer. A tensor is
// a stack of planes, one for each block of four channels of each image, block by block: plane
// `block * BATCH + image`. What a kernel does not bind keeps the size 1.

override BATCH: u32 = 1u;

override INPUT_PLANES: u32 = 1u;
override INPUT_HEIGHT: u32 = 1u;
override INPUT_WIDTH: u32 = 1u;
override INPUT_MARGIN: u32 = 0u;
override INPUT_FULL: bool = true;

override SECOND_PLANES: u32 = 1u;
override SECOND_HEIGHT: u32 = 1u;
override SECOND_WIDTH: u32 = 1u;
override SECOND_MARGIN: u32 = 0u;
override SECOND_FULL: bool = true;

override OUTPUT_PLANES: u32 = 1u;
override OUTPUT_HEIGHT: u32 = 1u;
override OUTPUT_WIDTH: u32 = 1u;
override OUTPUT_MARGIN: u32 = 0u;
override OUTPUT_FULL: bool = true;

// Where a texel is in its stack.
struct Place {
    plane: u32,
    y: u32,
    x: u32,
}

// Of texel number `index` of the output, row by row and plane by plane; beyond the last plane for
// numbers beyond the last texel.
fn output_place(index: u32) -> Place {
    return Place(
        index / (OUTPUT_WIDTH * OUTPUT_HEIGHT),
        index / OUTPUT_WIDTH % OUTPUT_HEIGHT,
        index % OUTPUT_WIDTH,
    );
}
