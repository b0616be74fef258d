//! What the renderer draws: meshes in places, with materials, under lights, before a camera.

use glam::{DAffine3, DVec3};

/// How an item takes part in the picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Part of the robot: visible, and 1 in the mask.
    Robot,
    /// Casts the robot's shadow and is not seen.
    Shadow,
    /// Visible, casts a shadow, and hides the robot behind it from the mask.
    Scenery,
    /// Like scenery, without a shadow: floors and walls.
    Surface,
    /// A cable: visible, but what the mask says of the pixel stays.
    Cable,
}

impl Kind {
    /// Whether the item is drawn into the shadow map.
    pub fn casts_shadow(self) -> bool {
        matches!(self, Kind::Shadow | Kind::Scenery | Kind::Cable)
    }
}

/// What a surface looks like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Linear RGB in [0, 1].
    pub albedo: [f32; 3],
    /// 0 for a matt surface, 1 for one that only mirrors its surroundings.
    pub metal: f32,
    /// Strength of the highlights.
    pub specular: f32,
    /// Exponent of the highlights.
    pub shininess: f32,
    /// How much of the texture photo replaces the colour, 0 to 1.
    pub photo: f32,
    /// Repeats of the photo a metre.
    pub photo_scale: f32,
    /// Where on the photo the surface's origin is, in photo widths and heights.
    pub photo_offset: [f32; 2],
}

/// A mesh with a place and a material.
#[derive(Debug, Clone)]
pub struct Item {
    /// Which of the stage's meshes.
    pub mesh: usize,
    /// From the mesh's frame to the robot's base frame, scale included.
    pub base_from_mesh: DAffine3,
    /// What it looks like.
    pub material: Material,
    /// How it takes part.
    pub kind: Kind,
}

/// A light from far away.
#[derive(Debug, Clone, Copy)]
pub struct Lamp {
    /// Unit vector towards the light, base frame.
    pub direction: DVec3,
    /// Linear RGB; 0 is off.
    pub colour: [f32; 3],
}

/// All light in a scene.
#[derive(Debug, Clone)]
pub struct Lighting {
    /// Lights; the first one casts shadows.
    pub lamps: [Lamp; 3],
    /// How dark its shadows are, 0 to 1.
    pub shadow: f32,
    /// Linear RGB of the light from above.
    pub sky: [f32; 3],
    /// Linear RGB of the light from below.
    pub ground: [f32; 3],
    /// What metal mirrors: waves over directions of the base frame (wave vector, phase).
    pub mirrored: [(DVec3, f32); 3],
}

/// Everything that the renderer draws, but for the photos.
#[derive(Debug, Clone)]
pub struct Scene {
    /// From the robot's base frame to the camera optical frame.
    pub camera_from_base: DAffine3,
    /// The things.
    pub items: Vec<Item>,
    /// The light.
    pub lighting: Lighting,
    /// The middle of the scene, base frame: shadows are drawn around it.
    pub centre: DVec3,
}
