/// A camera that a network looks through: where the canonical camera is, turned to the robot, zoomed in on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gaze {
    /// Rows of the rotation from the canonical camera's frame to this one's.
    pub rotation: [[f32; 3]; 3],
    /// Its focal length, as a multiple of the canonical camera's.
    pub zoom: f32,
}

impl Gaze {
    /// The canonical camera itself.
    pub const CANONICAL: Self = Self {
        rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        zoom: 1.0,
    };

    /// Turned, without a roll, to what the canonical camera sees at `slope`, `x / z` and `y / z`, and zoomed in by `zoom`.
    pub fn towards([x, y]: [f32; 2], zoom: f32) -> Self {
        let length = (x * x + y * y + 1.0).sqrt();
        let [x, y, z] = [x / length, y / length, 1.0 / length];
        // The shortest turn that brings the axis to the ray.
        let [bent_x, bent_y] = [x / (1.0 + z), y / (1.0 + z)];
        Self {
            rotation: [
                [1.0 - x * bent_x, -x * bent_y, -x],
                [-y * bent_x, 1.0 - y * bent_y, -y],
                [x, y, z],
            ],
            zoom,
        }
    }

    /// What lies in the direction `ray` of the canonical camera's frame, in this one's.
    pub fn turned(&self, ray: [f32; 3]) -> [f32; 3] {
        let along = |axis: [f32; 3]| axis[0] * ray[0] + axis[1] * ray[1] + axis[2] * ray[2];
        self.rotation.map(along)
    }

    /// What lies in the direction `seen`, in the canonical camera's frame.
    pub fn turned_back(&self, seen: [f32; 3]) -> [f32; 3] {
        let [right, down, ahead] = self.rotation;
        [0, 1, 2].map(|axis| right[axis] * seen[0] + down[axis] * seen[1] + ahead[axis] * seen[2])
    }
}
