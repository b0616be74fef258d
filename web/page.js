// The page: takes pictures from files, videos and cameras to the engine, and shows what it says.
import { open } from './engine.js';
import { assumed_hfov } from './whereabot_web.js';

const $ = (id) => document.getElementById(id);
const JOINT_COLOURS = ['#e63946', '#ff961e', '#ffe13c', '#3c87ff', '#9b55e1', '#ff82c8'];
// Larger photographs are scaled down: the networks see less anyway.
const LONGEST_SIDE = 2048;

let engine;
// What is searched: {picture, width, height, live, mirrored, track, stop}, picture an ImageBitmap or a <video>, track a
// camera's.
let source;
let report;

// The engine does one thing at a time.
let last = Promise.resolve();
function inTurn(task) {
  const turn = last.then(task);
  last = turn.catch(() => {});
  return turn;
}

function complain(error) {
  $('notice').textContent = error.message ?? error;
  $('notice').hidden = false;
}

// For what the engine says while it searches.
function complainOfEngine(error) {
  complain(error);
  if (!engine?.gpu) return;
  const link = Object.assign(document.createElement('a'), { href: '?engine=cpu', textContent: 'Run without the GPU' });
  $('notice').append('. ', link);
}

// Runs what a person asked for.
async function attempt(task) {
  $('notice').hidden = true;
  try {
    await task();
  } catch (error) {
    complain(error);
  }
}

// --- searching

let wanted = false;
let running = false;

// Searches the source, from now on if it is live; again if something changed meanwhile.
async function refresh() {
  wanted = true;
  if (running) return;
  running = true;
  try {
    while (source && (wanted || (source.live && !source.picture.paused))) {
      wanted = false;
      await inTurn(() => search(source));
      if (source?.live) await nextFrame(source.picture);
    }
  } catch (error) {
    complainOfEngine(error);
  } finally {
    running = false;
  }
}

function nextFrame(video) {
  return new Promise((resolve) => {
    // A video that pauses has no next frame.
    video.onpause = resolve;
    if (video.paused) resolve();
    else if (video.requestVideoFrameCallback) video.requestVideoFrameCallback(resolve);
    else requestAnimationFrame(resolve);
  });
}

async function search(from) {
  // A camera may end before its turn comes.
  if (!from || from.picture.readyState < HTMLMediaElement.HAVE_CURRENT_DATA) return;
  if (from.live) followSize(from);
  const { picture, width, height } = from;
  const slow = setTimeout(() => $('caption').classList.add('busy'), 300);
  if ($('picture').width !== width || $('picture').height !== height) {
    Object.assign($('picture'), { width, height });
  }
  const start = performance.now();
  try {
    const answer = await engine.locate(picture, width, height, Number($('hfov').value));
    if (from === source) show(answer, performance.now() - start);
  } finally {
    clearTimeout(slow);
    $('caption').classList.remove('busy');
  }
}

// A phone that is turned, and a video now and then, changes its pictures' size. What it sees along the longer side stays:
// the lens is the same.
function followSize(from) {
  const { videoWidth: width, videoHeight: height } = from.picture;
  if (from.width === width && from.height === height) return;
  // The tangent of half the angle, along the longer side.
  const half = Math.tan((Number($('hfov').value) * Math.PI) / 360) * (Math.max(from.width, from.height) / from.width);
  setHfov((Math.atan((half * width) / Math.max(width, height)) * 360) / Math.PI);
  Object.assign(from, { width, height });
}

// --- showing

function show({ status, coverage, joints }, ms) {
  $('view').classList.toggle('mirrored', source.mirrored);
  const robot = document.querySelector('[name=robot]:checked').value.toUpperCase();
  const words = { found: `${robot} found`, not_found: 'No robot', invalid: 'No sensible answer' };
  $('status').textContent = words[status];
  $('status').className = status;
  $('time').textContent = ms < 1000 ? `${ms.toFixed(ms < 100 ? 1 : 0)} ms` : `${(ms / 1000).toFixed(1)} s`;
  $('rate').textContent = rate();
  $('caption').textContent = `${words[status]} · ${$('time').textContent}`;
  $('coverage').textContent = `${(100 * coverage).toFixed(1)} %`;
  $('positions').hidden = joints.length === 0;
  $('positions').tBodies[0].replaceChildren(...joints.map(({ name, xyz_m }, index) => {
    const dot = document.createElement('i');
    dot.style.background = colour(index);
    const cells = [name.replaceAll('_', ' '), ...xyz_m.map((v) => v.toFixed(3))];
    const row = tableRow(cells);
    row.cells[0].prepend(dot);
    return row;
  }));
  drawJoints(joints);
}

const times = [];
function rate() {
  times.push(performance.now());
  if (times.length > 20) times.shift();
  if (!source.live || times.length < 2) return '–';
  const perSecond = (1000 * (times.length - 1)) / (times.at(-1) - times[0]);
  return perSecond.toFixed(perSecond < 10 ? 1 : 0);
}

const colour = (index) => JOINT_COLOURS[index % JOINT_COLOURS.length];

function drawJoints(joints) {
  const canvas = $('joints');
  const { width, height, mirrored } = source;
  const scale = (canvas.clientWidth * devicePixelRatio) / width;
  Object.assign(canvas, { width: width * scale, height: height * scale });
  const context = canvas.getContext('2d');
  // Pixel (0, 0) of an answer is the centre of the top-left pixel.
  const points = joints.map(({ px: [x, y] }) => [(mirrored ? width - 0.5 - x : x + 0.5) * scale, (y + 0.5) * scale]);
  const radius = Math.max(5 * devicePixelRatio, canvas.width / 85);
  context.lineJoin = context.lineCap = 'round';
  for (const [style, share] of [['#141418', 0.75], ['#f5f5f5', 0.4]]) {
    context.strokeStyle = style;
    context.lineWidth = share * radius;
    context.beginPath();
    points.forEach(([x, y]) => context.lineTo(x, y));
    context.stroke();
  }
  points.forEach(([x, y], index) => {
    for (const [style, share] of [['#141418', 1], [colour(index), 0.75]]) {
      context.fillStyle = style;
      context.beginPath();
      context.arc(x, y, share * radius, 0, 2 * Math.PI);
      context.fill();
    }
  });
}

function tableRow(cells) {
  const row = document.createElement('tr');
  cells.forEach((text) => (row.insertCell().textContent = text));
  return row;
}

// --- sources

// Searches `next` from now on, whose camera sees `hfov` degrees across.
function use(next, hfov = assumed_hfov(next.width, next.height)) {
  source?.stop?.();
  source = { live: false, mirrored: false, ...next };
  times.length = 0;
  setHfov(hfov);
  document.querySelector('.live').hidden = !source.live;
  $('flip').hidden = !source.camera;
  $('pause').textContent = 'Pause';
  $('hint').hidden = true;
  $('caption').textContent = 'looking for the robot';
  $('caption').hidden = false;
  return refresh();
}

// Lets go of a camera that was unplugged: its last answer is not shown as one of now.
function loseCamera(track) {
  if (source?.track !== track) return;
  drawJoints([]);
  source.stop();
  source = undefined;
  $('status').textContent = 'No camera';
  $('status').className = '';
  for (const id of ['time', 'rate', 'coverage']) $(id).textContent = '–';
  $('positions').hidden = true;
  document.querySelector('.live').hidden = true;
  $('caption').textContent = 'the camera has ended';
  complain('The camera has ended: what is shown is its last picture.');
}

function setHfov(degrees) {
  $('hfov').value = degrees;
  $('degrees').textContent = `${Number($('hfov').value).toFixed(1)}°`;
}

async function usePicture(blob, extras, hfov) {
  let bitmap = await createImageBitmap(blob).catch(() => {
    throw new Error('This browser cannot read that picture.');
  });
  const scale = LONGEST_SIDE / Math.max(bitmap.width, bitmap.height);
  if (scale < 1) {
    const size = { resizeWidth: Math.round(bitmap.width * scale), resizeHeight: Math.round(bitmap.height * scale) };
    bitmap = await createImageBitmap(bitmap, { ...size, resizeQuality: 'high' });
  }
  const { width, height } = bitmap;
  await use({ picture: bitmap, width, height, ...extras }, hfov);
}

async function useVideo(properties, extras, stop) {
  const video = Object.assign(document.createElement('video'), { muted: true, playsInline: true, loop: true, ...properties });
  await video.play().catch(() => {
    stop();
    throw new Error('This browser cannot play that video.');
  });
  const stopped = () => {
    video.pause();
    stop();
  };
  await use({ picture: video, width: video.videoWidth, height: video.videoHeight, live: true, stop: stopped, ...extras });
}

async function useFile(file) {
  if (!file) return;
  if (!file.type.startsWith('video/')) return usePicture(file);
  const src = URL.createObjectURL(file);
  await useVideo({ src }, {}, () => URL.revokeObjectURL(src));
}

async function useCamera(facingMode) {
  if (!navigator.mediaDevices) throw new Error('Cameras need a secure page (https).');
  source?.stop?.();
  const size = { width: { ideal: 1280 }, height: { ideal: 720 } };
  const stream = await navigator.mediaDevices.getUserMedia({ video: { facingMode, ...size } });
  const [track] = stream.getVideoTracks();
  // Only the view is mirrored: in a mirror, a left-handed robot would be searched.
  const mirrored = track.getSettings().facingMode === 'user';
  track.onended = () => loseCamera(track);
  await useVideo({ srcObject: stream }, { camera: facingMode, mirrored, track }, () => track.stop());
}

async function useSample() {
  const robot = document.querySelector('[name=robot]:checked').value;
  // As the pictures' camera_info.yaml says.
  await usePicture(await fetched(`samples/${robot}.jpg`), { sample: true }, 70.1);
}

async function fetched(url) {
  const response = await fetch(url);
  if (!response.ok) throw new Error(`${url}: the server says ${response.status}`);
  return response.blob();
}

async function loadRobot() {
  const robot = document.querySelector('[name=robot]:checked').value;
  const url = `weights/${robot}.safetensors`;
  const file = new Uint8Array(await (await fetched(url)).arrayBuffer());
  await inTurn(() => engine.load(file, url));
}

// --- benchmark

async function measure() {
  $('measure').disabled = true;
  $('progress').textContent = 'waiting';
  try {
    report = await inTurn(() => engine.benchmark((text) => ($('progress').textContent = `measuring: ${text}`)));
    const { layers, cascade: [all] } = JSON.parse(report);
    const longest = Math.max(...layers.map(({ ms_p50 }) => ms_p50));
    const rows = layers.map(({ layer, ms_p50 }) => {
      const row = tableRow([layer, ms_p50.toFixed(ms_p50 < 10 ? 2 : 0)]);
      row.cells[0].style.setProperty('--share', `${(100 * ms_p50) / longest}%`);
      return row;
    });
    $('layers').tBodies[0].replaceChildren(...rows);
    $('layers').hidden = $('copy').hidden = false;
    $('progress').textContent = `${all.frames_per_s.toFixed(1)} pictures a second: ${all.wall_ms_p50.toFixed(1)} ms each, from memory to memory`;
  } catch (error) {
    $('progress').textContent = '';
    throw error;
  } finally {
    $('measure').disabled = false;
  }
}

async function copy(button, text) {
  const name = button.textContent;
  await navigator.clipboard.writeText(text);
  button.textContent = 'Copied';
  setTimeout(() => (button.textContent = name), 1500);
}

// --- verification

async function verify() {
  $('verify').disabled = true;
  $('verdict').textContent = 'waiting';
  try {
    const json = await inTurn(() => engine.verify((text) => ($('verdict').textContent = `comparing: ${text}`)));
    $('verdict').textContent = JSON.parse(json).line;
    $('copy-line').hidden = false;
  } catch (error) {
    $('verdict').textContent = '';
    throw error;
  } finally {
    $('verify').disabled = false;
  }
}

// --- what people do

const on = (id, event, task) => $(id).addEventListener(event, (happened) => attempt(() => task(happened)));

on('sample', 'click', useSample);
for (const id of ['image', 'video']) {
  on(id, 'change', ({ target }) => useFile(target.files[0]).finally(() => (target.value = '')));
}
on('camera', 'click', () => useCamera('environment'));
on('flip', 'click', () => useCamera(source.camera === 'environment' ? 'user' : 'environment'));
on('pause', 'click', async () => {
  const video = source.picture;
  $('pause').textContent = video.paused ? 'Pause' : 'Go on';
  if (!video.paused) return video.pause();
  await video.play();
  await refresh();
});
on('robots', 'change', async () => {
  await loadRobot();
  await (source?.sample ? useSample() : refresh());
});
on('hfov', 'input', () => {
  setHfov($('hfov').value);
  return refresh();
});
on('measure', 'click', measure);
on('copy', 'click', ({ target }) => copy(target, report));
on('verify', 'click', verify);
on('copy-line', 'click', ({ target }) => copy(target, $('verdict').textContent));

for (const event of ['dragover', 'dragleave', 'drop']) {
  $('view').addEventListener(event, (happened) => {
    happened.preventDefault();
    $('view').classList.toggle('dropping', event === 'dragover');
    if (event === 'drop') attempt(() => useFile(happened.dataTransfer.files[0]));
  });
}

// A defect in the engine leaves nothing to wait for.
addEventListener('error', ({ message }) => complainOfEngine(message));

attempt(async () => {
  const opened = await open($('picture'), new URLSearchParams(location.search).get('engine'));
  engine = opened.engine;
  $('engine').textContent = engine.name;
  await loadRobot();
  document.querySelector('.stage').inert = false;
  $('measure').disabled = false;
  $('verification').hidden = !engine.verify;
  await useSample();
  if (opened.why) complain(`${opened.why}: the networks run in plain Rust on one core of this device.`);
});
