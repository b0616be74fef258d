//! Triangle meshes: the readers for COLLADA, STL and OBJ, and three primitives.

use std::collections::HashMap;
use std::f32::consts::{PI, TAU};
use std::path::Path;

use glam::{Affine3A, Mat4, Vec3};
use roxmltree::{Document, Node};

use super::RobotError;

/// A triangle list of one material.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Vertex positions, metres, in the mesh's own frame.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals, one a position.
    pub normals: Vec<[f32; 3]>,
    /// Three indices into `positions` a triangle.
    pub indices: Vec<u32>,
    /// Diffuse colour that the file gives, RGB in [0, 1]; `None` where it gives none.
    pub diffuse: Option<[f32; 3]>,
}

impl Mesh {
    /// Reads every mesh of a COLLADA (.dae), STL or OBJ file, one for each material of each geometry.
    ///
    /// # Errors
    /// The file cannot be read, is of another kind, or breaks its format's rules.
    pub fn read(path: &Path) -> Result<Vec<Mesh>, RobotError> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("");
        let meshes = match extension.to_ascii_lowercase().as_str() {
            "dae" => read_collada(path)?,
            "stl" | "obj" => read_with_mesh_loader(path)?,
            other => {
                let message = format!("expected a .dae, .stl or .obj mesh, found .{other}");
                return Err(broken(path, message));
            }
        };
        if meshes.iter().all(|mesh| mesh.indices.is_empty()) {
            return Err(broken(path, "expected triangles, found none"));
        }
        for mesh in &meshes {
            let count = mesh.positions.len();
            if let Some(index) = mesh.indices.iter().find(|&&i| i as usize >= count) {
                let message = format!("a triangle wants vertex {index}, but there are {count}");
                return Err(broken(path, message));
            }
            if !mesh.positions.as_flattened().iter().all(|c| c.is_finite()) {
                return Err(broken(path, "expected finite coordinates, found others"));
            }
        }
        Ok(meshes)
    }

    /// A cube with edges of length 1 about the origin.
    pub fn cuboid() -> Mesh {
        let mut mesh = Mesh::default();
        for axis in 0..3 {
            for sign in [-1.0f32, 1.0] {
                let mut normal = [0.0; 3];
                normal[axis] = sign;
                let start = mesh.positions.len() as u32;
                for (a, b) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)] {
                    let mut position = [0.0; 3];
                    position[axis] = 0.5 * sign;
                    position[(axis + 1) % 3] = a;
                    position[(axis + 2) % 3] = b;
                    mesh.positions.push(position);
                    mesh.normals.push(normal);
                }
                mesh.indices.extend([0, 1, 2, 0, 2, 3].map(|i| start + i));
            }
        }
        mesh
    }

    /// A cylinder along z, radius 0.5 and height 1, about the origin.
    pub fn cylinder() -> Mesh {
        const SIDES: u32 = 24;
        let mut mesh = Mesh::default();
        for i in 0..=SIDES {
            let (sin, cos) = (TAU * i as f32 / SIDES as f32).sin_cos();
            for z in [-0.5, 0.5] {
                mesh.positions.push([0.5 * cos, 0.5 * sin, z]);
                mesh.normals.push([cos, sin, 0.0]);
            }
        }
        for i in 0..SIDES {
            let a = 2 * i;
            mesh.indices.extend([a, a + 2, a + 3, a, a + 3, a + 1]);
        }
        for z in [-1.0f32, 1.0] {
            let centre = mesh.positions.len() as u32;
            mesh.positions.push([0.0, 0.0, 0.5 * z]);
            mesh.normals.push([0.0, 0.0, z]);
            for i in 0..=SIDES {
                let (sin, cos) = (TAU * i as f32 / SIDES as f32).sin_cos();
                mesh.positions.push([0.5 * cos, 0.5 * sin, 0.5 * z]);
                mesh.normals.push([0.0, 0.0, z]);
                if i < SIDES {
                    mesh.indices
                        .extend([centre, centre + 1 + i, centre + 2 + i]);
                }
            }
        }
        mesh
    }

    /// A sphere of radius 0.5 about the origin.
    pub fn sphere() -> Mesh {
        const SIDES: u32 = 24;
        const RINGS: u32 = 12;
        let mut mesh = Mesh::default();
        for ring in 0..=RINGS {
            let (sin_t, cos_t) = (PI * ring as f32 / RINGS as f32).sin_cos();
            for side in 0..=SIDES {
                let (sin_p, cos_p) = (TAU * side as f32 / SIDES as f32).sin_cos();
                let normal = [sin_t * cos_p, sin_t * sin_p, cos_t];
                mesh.positions.push(normal.map(|c| 0.5 * c));
                mesh.normals.push(normal);
            }
        }
        for ring in 0..RINGS {
            for side in 0..SIDES {
                let a = ring * (SIDES + 1) + side;
                let b = a + SIDES + 1;
                mesh.indices.extend([a, b, b + 1, a, b + 1, a + 1]);
            }
        }
        mesh
    }

    /// Moves and scales all vertices by `map`; normals follow its inverse transpose.
    pub fn transform(&mut self, map: Affine3A) {
        let normal_map = map.matrix3.inverse().transpose();
        for p in &mut self.positions {
            *p = map.transform_point3(Vec3::from(*p)).into();
        }
        for n in &mut self.normals {
            *n = (normal_map * Vec3::from(*n)).normalize_or_zero().into();
        }
    }
}

fn broken(path: &Path, message: impl Into<String>) -> RobotError {
    RobotError::Mesh {
        path: path.to_owned(),
        message: message.into(),
    }
}

fn read_with_mesh_loader(path: &Path) -> Result<Vec<Mesh>, RobotError> {
    let scene = mesh_loader::Loader::default()
        .load(path)
        .map_err(RobotError::io(path))?;
    let meshes = scene.meshes.iter().zip(&scene.materials);
    Ok(meshes
        .filter(|(mesh, _)| !mesh.faces.is_empty())
        .map(|(mesh, material)| {
            let diffuse = material.color.diffuse.map(|[r, g, b, _]| [r, g, b]);
            if mesh.normals.len() == mesh.vertices.len() {
                Mesh {
                    positions: mesh.vertices.clone(),
                    normals: mesh.normals.clone(),
                    indices: mesh.faces.as_flattened().to_vec(),
                    diffuse,
                }
            } else {
                let triangles = mesh
                    .faces
                    .iter()
                    .map(|f| f.map(|i| mesh.vertices.get(i as usize).copied().unwrap_or_default()));
                flat_shaded(triangles, diffuse)
            }
        })
        .collect())
}

/// Triangles with the normal of their own plane at each corner.
fn flat_shaded(triangles: impl Iterator<Item = [[f32; 3]; 3]>, diffuse: Option<[f32; 3]>) -> Mesh {
    let mut mesh = Mesh {
        diffuse,
        ..Mesh::default()
    };
    for corners in triangles {
        let [a, b, c] = corners.map(Vec3::from);
        let normal = (b - a).cross(c - a).normalize_or_zero().into();
        for corner in corners {
            mesh.indices.push(mesh.positions.len() as u32);
            mesh.positions.push(corner);
            mesh.normals.push(normal);
        }
    }
    mesh
}

type Element<'a> = Node<'a, 'a>;

fn child<'a>(node: Element<'a>, name: &'a str) -> Option<Element<'a>> {
    children(node, name).next()
}

fn children<'a>(node: Element<'a>, name: &'a str) -> impl Iterator<Item = Element<'a>> {
    node.children().filter(move |n| n.tag_name().name() == name)
}

fn descendant<'a>(node: Element<'a>, name: &str) -> Option<Element<'a>> {
    node.descendants().find(|n| n.tag_name().name() == name)
}

fn numbers<T: std::str::FromStr>(node: Element<'_>) -> Option<Vec<T>> {
    node.text()
        .unwrap_or("")
        .split_ascii_whitespace()
        .map(|t| t.parse().ok())
        .collect()
}

/// A COLLADA file: `triangles` and `polylist` primitives with positions and normals, placed by the
/// visual scene's nodes. The unit is honoured; the up axis is not, as ROS tools ignore it.
fn read_collada(path: &Path) -> Result<Vec<Mesh>, RobotError> {
    let text = std::fs::read_to_string(path).map_err(RobotError::io(path))?;
    let document = Document::parse(&text).map_err(|e| broken(path, format!("not XML: {e}")))?;
    let root = document.root_element();
    let by_id: HashMap<&str, Element<'_>> = root
        .descendants()
        .filter_map(|n| Some((n.attribute("id")?, n)))
        .collect();
    let unit = descendant(root, "unit")
        .and_then(|n| n.attribute("meter"))
        .map_or(Some(1.0), |t| t.parse::<f32>().ok())
        .ok_or_else(|| broken(path, "expected a number in <unit meter=…>"))?;
    let scene = descendant(root, "visual_scene")
        .ok_or_else(|| broken(path, "expected a <visual_scene>, found none"))?;
    let reader = Collada { path, by_id };
    let mut meshes = Vec::new();
    for node in children(scene, "node") {
        reader.node(node, Affine3A::from_scale(Vec3::splat(unit)), &mut meshes)?;
    }
    Ok(meshes)
}

struct Collada<'a> {
    path: &'a Path,
    by_id: HashMap<&'a str, Element<'a>>,
}

impl<'a> Collada<'a> {
    fn error(&self, message: impl Into<String>) -> RobotError {
        broken(self.path, message)
    }

    fn follow(&self, url: Option<&str>) -> Result<Element<'a>, RobotError> {
        let url = url.unwrap_or("");
        self.by_id
            .get(url.trim_start_matches('#'))
            .copied()
            .ok_or_else(|| self.error(format!("\"{url}\" refers to nothing in the file")))
    }

    fn node(
        &self,
        node: Element<'a>,
        parent: Affine3A,
        meshes: &mut Vec<Mesh>,
    ) -> Result<(), RobotError> {
        let mut pose = parent;
        for element in node.children().filter(Node::is_element) {
            let name = element.tag_name().name();
            if !matches!(name, "matrix" | "translate" | "rotate" | "scale") {
                continue;
            }
            let values = numbers::<f32>(element);
            pose *= match (name, values.as_deref()) {
                ("matrix", Some(m)) if m.len() == 16 => {
                    Affine3A::from_mat4(Mat4::from_cols_slice(m).transpose())
                }
                ("translate", Some(&[x, y, z])) => Affine3A::from_translation(Vec3::new(x, y, z)),
                ("scale", Some(&[x, y, z])) => Affine3A::from_scale(Vec3::new(x, y, z)),
                ("rotate", Some(&[x, y, z, degrees])) => {
                    let axis = Vec3::new(x, y, z).normalize_or(Vec3::Z);
                    Affine3A::from_axis_angle(axis, degrees.to_radians())
                }
                _ => return Err(self.error(format!("a <{name}> has the wrong numbers"))),
            };
        }
        for instance in children(node, "instance_geometry") {
            let geometry = self.follow(instance.attribute("url"))?;
            for mut mesh in self.geometry(geometry, instance)? {
                mesh.transform(pose);
                meshes.push(mesh);
            }
        }
        children(node, "node").try_for_each(|n| self.node(n, pose, meshes))
    }

    fn geometry(
        &self,
        geometry: Element<'a>,
        instance: Element<'a>,
    ) -> Result<Vec<Mesh>, RobotError> {
        let Some(mesh) = child(geometry, "mesh") else {
            return Ok(Vec::new());
        };
        mesh.children()
            .filter(|n| matches!(n.tag_name().name(), "triangles" | "polylist"))
            .map(|primitive| {
                let mut mesh = self.primitive(primitive)?;
                mesh.diffuse = primitive
                    .attribute("material")
                    .and_then(|symbol| self.diffuse(symbol, instance));
                Ok(mesh)
            })
            .collect()
    }

    /// The diffuse colour bound to a material symbol, where there is one.
    fn diffuse(&self, symbol: &str, instance: Element<'a>) -> Option<[f32; 3]> {
        let bound = instance
            .descendants()
            .find(|n| n.attribute("symbol") == Some(symbol))
            .and_then(|n| n.attribute("target"))
            .unwrap_or(symbol);
        let material = self.follow(Some(bound)).ok()?;
        let effect = self
            .follow(child(material, "instance_effect")?.attribute("url"))
            .ok()?;
        let colour = child(descendant(effect, "diffuse")?, "color")?;
        match numbers::<f32>(colour)?.as_slice() {
            &[r, g, b, ..] => Some([r, g, b]),
            _ => None,
        }
    }

    fn vectors(&self, source: Element<'a>) -> Result<Vec<[f32; 3]>, RobotError> {
        let array = child(source, "float_array")
            .and_then(numbers::<f32>)
            .ok_or_else(|| self.error("a <source> without a readable <float_array>"))?;
        Ok(array.as_chunks::<3>().0.to_vec())
    }

    fn primitive(&self, primitive: Element<'a>) -> Result<Mesh, RobotError> {
        let mut stride = 0;
        let mut positions = None;
        let mut normals = None;
        for input in children(primitive, "input") {
            let offset: u16 = input
                .attribute("offset")
                .and_then(|o| o.parse().ok())
                .unwrap_or(0);
            let offset = usize::from(offset);
            stride = stride.max(offset + 1);
            let source = self.follow(input.attribute("source"))?;
            match input.attribute("semantic") {
                Some("VERTEX") => {
                    for inner in children(source, "input") {
                        let vectors = self.follow(inner.attribute("source"));
                        match inner.attribute("semantic") {
                            Some("POSITION") => positions = Some((offset, self.vectors(vectors?)?)),
                            Some("NORMAL") => normals = Some((offset, self.vectors(vectors?)?)),
                            _ => {}
                        }
                    }
                }
                Some("NORMAL") => normals = Some((offset, self.vectors(source)?)),
                _ => {}
            }
        }
        let (position_at, positions) =
            positions.ok_or_else(|| self.error("a primitive without positions"))?;
        let corners: Vec<u32> = child(primitive, "p")
            .and_then(numbers)
            .ok_or_else(|| self.error("a primitive without readable indices <p>"))?;
        let corners: Vec<&[u32]> = corners.chunks_exact(stride).collect();
        let polygons: Vec<usize> = match child(primitive, "vcount") {
            Some(counts) => {
                numbers(counts).ok_or_else(|| self.error("a <vcount> that holds no counts"))?
            }
            None => vec![3; corners.len() / 3],
        };
        let mut triangles = Vec::new();
        let mut start = 0usize;
        for count in polygons {
            let polygon = corners
                .get(start..start.saturating_add(count))
                .ok_or_else(|| self.error("fewer indices than the polygons need"))?;
            for pair in polygon.get(1..).unwrap_or_default().windows(2) {
                triangles.push([polygon[0], pair[0], pair[1]]);
            }
            start += count;
        }

        let position = |corner: &[u32]| {
            let index = corner.get(position_at).copied().unwrap_or(u32::MAX);
            positions
                .get(index as usize)
                .copied()
                .ok_or_else(|| self.error(format!("index {index} beyond the positions")))
        };
        let Some((normal_at, normals)) = normals else {
            let corners: Result<Vec<[[f32; 3]; 3]>, RobotError> = triangles
                .iter()
                .map(|t| Ok([position(t[0])?, position(t[1])?, position(t[2])?]))
                .collect();
            return Ok(flat_shaded(corners?.into_iter(), None));
        };
        let mut mesh = Mesh::default();
        let mut seen: HashMap<(u32, u32), u32> = HashMap::new();
        for &corner in triangles.iter().flatten() {
            let normal_index = corner.get(normal_at).copied().unwrap_or(u32::MAX);
            let key = (
                corner.get(position_at).copied().unwrap_or(u32::MAX),
                normal_index,
            );
            let index = match seen.get(&key) {
                Some(&index) => index,
                None => {
                    let index = mesh.positions.len() as u32;
                    mesh.positions.push(position(corner)?);
                    let normal = normals.get(normal_index as usize).copied().ok_or_else(|| {
                        self.error(format!("index {normal_index} beyond the normals"))
                    })?;
                    mesh.normals.push(normal);
                    seen.insert(key, index);
                    index
                }
            };
            mesh.indices.push(index);
        }
        Ok(mesh)
    }
}
