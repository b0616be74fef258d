// Arms and cameras in space, on a 2D canvas. Points in a scene are metres: right, up, towards the viewer.

// Draws a scene {floor, rings, cameras: [{name, colour, pose, size, intrinsics, joints}]}: `pose` takes points of a
// camera's optical frame to the scene, `joints` are {at, colour} there; on the floor are rings or else a grid.
export class Space {
  #canvas;
  #scene = null;
  #yaw = 0.6;
  #pitch = 0.35;
  #zoom = 1;
  #middle = [0, 0, 0];
  #radius = 1;
  #fresh = true;

  constructor(canvas) {
    this.#canvas = canvas;
    const pointers = new Map();
    const distance = () => {
      const [a, b] = [...pointers.values()];
      return b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 0;
    };
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
    });
    for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    canvas.addEventListener('pointermove', (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const apart = distance();
      pointers.set(event.pointerId, event);
      if (pointers.size === 1) this.#turn((before.clientX - event.clientX) / 150, (event.clientY - before.clientY) / 150);
      else if (apart > 0) this.#come(apart / distance());
    });
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.#come(Math.exp(event.deltaY / 600));
    });
    canvas.addEventListener('keydown', (event) => {
      const turns = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      const steps = { '+': 0.9, '=': 0.9, '-': 1 / 0.9 };
      if (turns[event.key]) this.#turn(...turns[event.key]);
      else if (steps[event.key]) this.#come(steps[event.key]);
      else return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.#draw()).observe(canvas);
  }

  // Another scene comes into view at once, the next state of the same one smoothly.
  show(scene, isAnother) {
    this.#scene = scene;
    this.#fresh ||= isAnother;
    this.#fit();
    this.#draw();
  }

  #turn(yaw, pitch) {
    this.#yaw += yaw;
    this.#pitch = Math.min(1.5, Math.max(-0.4, this.#pitch + pitch));
    this.#draw();
  }

  #come(factor) {
    this.#zoom = Math.min(5, Math.max(0.2, this.#zoom * factor));
    this.#draw();
  }

  #fit() {
    const points = this.#scene.cameras.flatMap(({ pose, joints }) => [place(pose, [0, 0, 0]), ...joints.map(({ at }) => at)]);
    if (points.length === 0) return;
    const low = [0, 1, 2].map((axis) => Math.min(...points.map((point) => point[axis])));
    const high = [0, 1, 2].map((axis) => Math.max(...points.map((point) => point[axis])));
    const share = this.#fresh ? 1 : 0.1;
    this.#fresh = false;
    const middle = mix(low, high, 0.5);
    this.#middle = mix(this.#middle, middle, share);
    this.#radius += share * (Math.max(0.5, 0.5 * Math.hypot(...subtract(high, low))) - this.#radius);
  }

  #draw() {
    const scene = this.#scene;
    const canvas = this.#canvas;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!scene || width === 0) return;
    Object.assign(canvas, { width: width * devicePixelRatio, height: height * devicePixelRatio });
    const context = canvas.getContext('2d');
    context.scale(devicePixelRatio, devicePixelRatio);
    context.lineJoin = context.lineCap = 'round';
    // The style sheet's, as a canvas knows no light-dark().
    const { color: faint, borderTopColor: line, caretColor: text } = getComputedStyle(canvas);

    const away = 2.1 * this.#radius * this.#zoom;
    const [sinYaw, cosYaw, sinPitch, cosPitch] = [Math.sin(this.#yaw), Math.cos(this.#yaw), Math.sin(this.#pitch), Math.cos(this.#pitch)];
    const focal = 1.15 * Math.min(width, height);
    // [x, y, depth] on the canvas; none for what is behind.
    const project = (point) => {
      const [x, y, z] = subtract(point, this.#middle);
      const [right, back] = [cosYaw * x - sinYaw * z, sinYaw * x + cosYaw * z];
      const [up, depth] = [cosPitch * y - sinPitch * back, away - (sinPitch * y + cosPitch * back)];
      return depth > 0.05 ? [width / 2 + (focal * right) / depth, height / 2 - (focal * up) / depth, depth] : null;
    };
    const stroke = (points, colour, thickness, alpha = 1) => {
      context.strokeStyle = colour;
      context.lineWidth = thickness;
      context.globalAlpha = alpha;
      context.beginPath();
      let pen = false;
      for (const point of points) {
        const at = project(point);
        if (at) context[pen ? 'lineTo' : 'moveTo'](at[0], at[1]);
        pen = at !== null;
      }
      context.stroke();
      context.globalAlpha = 1;
    };
    const write = (text, point, colour) => {
      const at = project(point);
      if (!at) return;
      context.fillStyle = colour;
      context.font = '12px system-ui, sans-serif';
      context.fillText(text, at[0] + 6, at[1] - 6);
    };

    const { floor, rings, cameras } = scene;
    if (rings) {
      for (const radius of [0.5, 1, 1.5, 2, 3, 4].filter((radius) => radius < 2.4 * this.#radius + 0.5)) {
        const ring = Array.from({ length: 73 }, (_, step) => {
          const angle = (step * Math.PI) / 36;
          return [radius * Math.cos(angle), floor, radius * Math.sin(angle)];
        });
        stroke(ring, line, 1.2);
        write(`${radius} m`, [0.3 * radius, floor, -0.95 * radius], faint);
      }
    } else {
      for (let at = -2; at <= 2; at += 0.5) {
        const thickness = at === 0 ? 1.8 : 1;
        stroke([[at, floor, -2], [at, floor, 2]], line, thickness);
        stroke([[-2, floor, at], [2, floor, at]], line, thickness);
      }
    }
    for (const { joints } of cameras) {
      for (const { at: [x, y, z] } of joints) stroke([[x, y, z], [x, floor, z]], faint, 1, 0.45);
      stroke(joints.map(({ at: [x, , z] }) => [x, floor, z]), faint, 3, 0.3);
    }
    for (const { name, colour, pose, size, intrinsics: { fx, fy, cx, cy } } of cameras) {
      const tip = place(pose, [0, 0, 0]);
      const deep = 0.15 * this.#radius;
      const [w, h] = size;
      const corners = [[-0.5, -0.5], [w - 0.5, -0.5], [w - 0.5, h - 0.5], [-0.5, h - 0.5]].map(([u, v]) =>
        place(pose, [(deep * (u - cx)) / fx, (deep * (v - cy)) / fy, deep]));
      stroke([...corners, corners[0]], colour, 1.8);
      for (const corner of corners) stroke([tip, corner], colour, 1.8);
      // The upper edge, so that up is seen.
      stroke([corners[0], mix(mix(corners[0], corners[1], 0.5), tip, -0.25), corners[1]], colour, 1.8);
      write(name, corners[1], text);
    }
    for (const { colour, joints } of cameras) {
      const points = joints.map(({ at }) => at);
      const thick = (0.045 * focal) / away;
      stroke(points, '#141418', thick + 2.5);
      stroke(points, cameras.length > 1 ? colour : '#aab4ae', thick);
      const drawn = joints.map(({ at, colour }) => ({ at: project(at), colour })).filter(({ at }) => at);
      for (const { at: [x, y, depth], colour } of drawn.sort((a, b) => b.at[2] - a.at[2])) {
        const radius = Math.max(3, (0.036 * focal) / depth);
        for (const [fill, share] of [['#141418', 1], [colour, 0.75]]) {
          context.fillStyle = fill;
          context.beginPath();
          context.arc(x, y, share * radius, 0, 2 * Math.PI);
          context.fill();
        }
      }
    }
  }
}

// A point through a matrix of three or four rows.
export function place(pose, [x, y, z]) {
  return pose.slice(0, 3).map(([a, b, c, d]) => a * x + b * y + c * z + d);
}

const subtract = (a, b) => a.map((value, axis) => value - b[axis]);
const mix = (a, b, share) => a.map((value, axis) => value + share * (b[axis] - value));
