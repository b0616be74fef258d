/// Colours of the joints, in the model's order; they begin again after the last.
pub const JOINT_COLOURS: [[u8; 3]; 6] = [
    [230, 57, 70],
    [255, 150, 30],
    [255, 225, 60],
    [60, 135, 255],
    [155, 85, 225],
    [255, 130, 200],
];
