//! The ROS 2 interfaces that are written, as text: what the MCAP specification calls `ros2msg`.

/// A message type: its full name, its definition, and those it is made of, theirs included.
pub struct Definition {
    /// Such as `sensor_msgs/msg/CompressedImage`.
    pub name: &'static str,
    text: &'static str,
    parts: &'static [Part],
}

/// The name, without `msg`, and the definition of a type that others are made of.
type Part = (&'static str, &'static str);

impl Definition {
    /// The definition, and below it those of the types that it needs, each once.
    pub fn schema(&self) -> String {
        let parts = self.parts.iter().map(|(name, text)| {
            let line = "=".repeat(80);
            format!("{line}\nMSG: {name}\n{text}")
        });
        std::iter::once(self.text.to_owned()).chain(parts).collect()
    }
}

/// An image in a picture file's format.
pub const COMPRESSED_IMAGE: Definition = Definition {
    name: "sensor_msgs/msg/CompressedImage",
    text: COMPRESSED_IMAGE_TEXT,
    parts: &[HEADER, TIME],
};

/// A camera's size, intrinsics and lens.
pub const CAMERA_INFO: Definition = Definition {
    name: "sensor_msgs/msg/CameraInfo",
    text: "\
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
",
    parts: &[HEADER, TIME, REGION_OF_INTEREST],
};

/// Shapes to draw.
pub const MARKER_ARRAY: Definition = Definition {
    name: "visualization_msgs/msg/MarkerArray",
    text: "visualization_msgs/Marker[] markers\n",
    parts: &[
        MARKER,
        HEADER,
        TIME,
        POSE,
        POINT,
        QUATERNION,
        VECTOR3,
        COLOUR,
        DURATION,
        ("sensor_msgs/CompressedImage", COMPRESSED_IMAGE_TEXT),
        UV_COORDINATE,
        MESH_FILE,
    ],
};

/// Places in one frame.
pub const POSE_ARRAY: Definition = Definition {
    name: "geometry_msgs/msg/PoseArray",
    text: "\
std_msgs/Header header
geometry_msgs/Pose[] poses
",
    parts: &[HEADER, TIME, POSE, POINT, QUATERNION],
};

/// How frames lie to each other.
pub const TF_MESSAGE: Definition = Definition {
    name: "tf2_msgs/msg/TFMessage",
    text: "geometry_msgs/TransformStamped[] transforms\n",
    parts: &[
        TRANSFORM_STAMPED,
        HEADER,
        TIME,
        TRANSFORM,
        VECTOR3,
        QUATERNION,
    ],
};

/// How things are, in words and values.
pub const DIAGNOSTIC_ARRAY: Definition = Definition {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    text: "\
std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status
",
    parts: &[HEADER, TIME, DIAGNOSTIC_STATUS, KEY_VALUE],
};

const COMPRESSED_IMAGE_TEXT: &str = "\
std_msgs/Header header
string format
uint8[] data
";

const HEADER: Part = (
    "std_msgs/Header",
    "\
builtin_interfaces/Time stamp
string frame_id
",
);

const TIME: Part = (
    "builtin_interfaces/Time",
    "\
int32 sec
uint32 nanosec
",
);

const DURATION: Part = (
    "builtin_interfaces/Duration",
    "\
int32 sec
uint32 nanosec
",
);

const REGION_OF_INTEREST: Part = (
    "sensor_msgs/RegionOfInterest",
    "\
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
",
);

const POSE: Part = (
    "geometry_msgs/Pose",
    "\
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
",
);

const POINT: Part = ("geometry_msgs/Point", XYZ);

const VECTOR3: Part = ("geometry_msgs/Vector3", XYZ);

const XYZ: &str = "\
float64 x
float64 y
float64 z
";

const QUATERNION: Part = (
    "geometry_msgs/Quaternion",
    "\
float64 x
float64 y
float64 z
float64 w
",
);

const TRANSFORM: Part = (
    "geometry_msgs/Transform",
    "\
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
",
);

const TRANSFORM_STAMPED: Part = (
    "geometry_msgs/TransformStamped",
    "\
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
",
);

const COLOUR: Part = (
    "std_msgs/ColorRGBA",
    "\
float32 r
float32 g
float32 b
float32 a
",
);

/// As it is since ROS 2 Galactic.
const MARKER: Part = (
    "visualization_msgs/Marker",
    "\
int32 ARROW=0
int32 CUBE=1
int32 SPHERE=2
int32 CYLINDER=3
int32 LINE_STRIP=4
int32 LINE_LIST=5
int32 CUBE_LIST=6
int32 SPHERE_LIST=7
int32 POINTS=8
int32 TEXT_VIEW_FACING=9
int32 MESH_RESOURCE=10
int32 TRIANGLE_LIST=11
int32 ADD=0
int32 MODIFY=0
int32 DELETE=2
int32 DELETEALL=3
std_msgs/Header header
string ns
int32 id
int32 type
int32 action
geometry_msgs/Pose pose
geometry_msgs/Vector3 scale
std_msgs/ColorRGBA color
builtin_interfaces/Duration lifetime
bool frame_locked
geometry_msgs/Point[] points
std_msgs/ColorRGBA[] colors
string texture_resource
sensor_msgs/CompressedImage texture
visualization_msgs/UVCoordinate[] uv_coordinates
string text
string mesh_resource
visualization_msgs/MeshFile mesh_file
bool mesh_use_embedded_materials
",
);

const UV_COORDINATE: Part = (
    "visualization_msgs/UVCoordinate",
    "\
float32 u
float32 v
",
);

const MESH_FILE: Part = (
    "visualization_msgs/MeshFile",
    "\
string filename
uint8[] data
",
);

const DIAGNOSTIC_STATUS: Part = (
    "diagnostic_msgs/DiagnosticStatus",
    "\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
",
);

const KEY_VALUE: Part = (
    "diagnostic_msgs/KeyValue",
    "\
string key
string value
",
);
