// Asks the program again and again for what has changed, and shows it.
import { Space, place } from './scene.js';

const $ = (id) => document.getElementById(id);
const JOINT_COLOURS = ['#e63946', '#ff961e', '#ffe13c', '#3c87ff', '#9b55e1', '#ff82c8'];
const CAMERA_COLOURS = ['#2fb67c', '#4b8df8', '#e08a1e', '#c65bd6', '#d94f5c', '#1fa7b8'];
// At most so often, in milliseconds.
const PERIOD = 80;
// An answer comes within a second, if only to say that nothing is new; a slow line brings it piece by piece.
const PATIENCE = 4000;
// For so long alarms are believed while the rest of an answer comes.
const LONGEST_ANSWER = 10000;
const OLD = 1000;
const CONDITIONS = { waiting: 'waiting', live: 'live', stale: 'no frames', failed: 'failed', ended: 'ended' };
const ALARM_WORDS = { clear: 'clear', warn: 'warning', stop: 'stop', unknown: 'unknown' };
// The worst last.
const ALARM_STATES = ['clear', 'unknown', 'warn', 'stop'];
const ALARM_ICONS = {
  clear: 'M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18m-4.5 9.3 3 3 6-6.3',
  warn: 'M12 3.5 2.5 20h19zM12 10v4.5m0 2.7v.1',
  stop: 'M8.2 3h7.6L21 8.2v7.6L15.8 21H8.2L3 15.8V8.2zM8 12h8',
  unknown: 'M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18M9.3 9.3a2.7 2.7 0 1 1 4 2.4c-.9.5-1.3 1-1.3 2m0 2.9v.1',
};

let run;
let change = 0;
// The cameras whose tiles the program has and did not send yet, first whose turn is next.
let owed = [];
let cameras = [];
let conditions = [];
// What the program last said of alarms, and what is shown of them.
let toldAlarms = [];
let alarms = [];
// Of each camera, its element and what was last seen: {article, tile, picture, tint, acquired}.
let views = [];
// The camera whose joints are listed; `together` is whether all are shown in space.
let chosen = 0;
let together = false;
let paused = false;
let lost = true;

const space = new Space($('space'));

// --- what comes

async function follow() {
  for (;;) {
    const start = performance.now();
    try {
      if (!paused) await ask();
    } catch {
      if (!paused) setLost(true);
    }
    if (paused) await new Promise((resolve) => $('pause').addEventListener('click', resolve, { once: true }));
    else await new Promise((resolve) => setTimeout(resolve, lost ? 1000 : PERIOD - (performance.now() - start)));
  }
}

let asking;
async function ask() {
  asking = new AbortController();
  let silence;
  const hear = () => {
    clearTimeout(silence);
    silence = setTimeout(() => asking.abort(), PATIENCE);
  };
  hear();
  try {
    const signal = AbortSignal.any([asking.signal, AbortSignal.timeout(LONGEST_ANSWER)]);
    const response = await fetch(`changes?since=${change}${owed.length > 0 ? `&owed=${owed}` : ''}`, { signal });
    // Ages are those of now, however long the rest takes.
    const sent = performance.now();
    if (!response.ok) throw new Error(await response.text());
    const read = reader(response.body, hear);
    const length = new DataView((await read(4)).buffer).getUint32(0, true);
    const message = JSON.parse(new TextDecoder().decode(await read(length)));
    // The program was started again, perhaps with other cameras.
    if (run !== undefined && run !== message.run) return location.reload();
    run = message.run;
    take(message);
    for (const tile of message.tiles) await takeTile(tile, sent, read);
    if (message.tiles.length > 0) showSpace(false);
  } finally {
    clearTimeout(silence);
  }
}

// Reads a stream by so many bytes, and calls `hear` whenever some come.
function reader(stream, hear) {
  const source = stream.getReader();
  let rest = new Uint8Array();
  return async (size) => {
    while (rest.length < size) {
      const { done, value } = await source.read();
      if (done) throw new Error('the answer is not whole');
      hear();
      const longer = new Uint8Array(rest.length + value.length);
      longer.set(rest);
      longer.set(value, rest.length);
      rest = longer;
    }
    const bytes = rest.slice(0, size);
    rest = rest.subarray(size);
    return bytes;
  };
}

// Alarms do not wait for pictures. What does not come of these is asked for again.
function take(message) {
  if (paused) return;
  change = message.change;
  owed = [...message.tiles.map(({ camera }) => camera), ...message.owed];
  if (message.cameras) meet(message.cameras);
  conditions = message.conditions;
  toldAlarms = message.alarms ?? toldAlarms;
  if (message.alarms || lost) showAlarms(toldAlarms);
  setLost(false);
  if (message.statistics) showRates(message.statistics);
  message.events.forEach(showEvent);
  notice(message.gpu_lost ? 'The GPU failed: nothing is searched until a device is open again.' : null);
  showConditions();
}

async function takeTile(tile, sent, read) {
  const image = (bytes, type) => (bytes.length > 0 ? createImageBitmap(new Blob([bytes], { type })) : null);
  const files = [await read(tile.picture_bytes), await read(tile.tint_bytes)];
  const [picture, tint] = await Promise.all([image(files[0], 'image/jpeg'), image(files[1], 'image/png')]);
  if (paused) return;
  const view = views[tile.camera];
  view.picture?.close();
  view.tint?.close();
  Object.assign(view, { tile, picture, tint, acquired: sent - tile.old_ms });
  owed = owed.filter((camera) => camera !== tile.camera);
  draw(tile.camera);
}

function meet(found) {
  cameras = found;
  views = cameras.map(({ name, robot }, index) => {
    const article = $('camera').content.firstElementChild.cloneNode(true);
    article.querySelector('h2').textContent = name;
    article.querySelector('.robot').textContent = robot;
    const button = article.querySelector('.view');
    button.setAttribute('aria-label', `${name}: show in space`);
    button.addEventListener('click', () => choose(index, false));
    new ResizeObserver(() => draw(index)).observe(button);
    return { article };
  });
  $('cameras').replaceChildren(...views.map(({ article }) => article));
  const options = cameras.map(({ name }, index) => new Option(`from ${name}`, index));
  together = cameras.filter(({ common_from_camera }) => common_from_camera).length > 1;
  if (together) options.unshift(new Option('all together', 'all'));
  $('which').replaceChildren(...options);
  choose(0, together);
}

function choose(index, all) {
  chosen = index;
  together = all;
  $('which').value = together ? 'all' : chosen;
  views.forEach(({ article }, at) => article.querySelector('.view').setAttribute('aria-pressed', !together && at === chosen));
  showSpace(true);
}

// --- pictures

const colour = (index) => JOINT_COLOURS[index % JOINT_COLOURS.length];

function draw(index) {
  const { article, tile, picture, tint } = views[index];
  if (!tile) return;
  const canvas = article.querySelector('canvas');
  if (index === views.findIndex((view) => view.tile)) {
    // The first camera's shape is all tiles' shape.
    $('cameras').style.setProperty('--shape', tile.width / tile.height);
  }
  const [width, height] = [canvas.clientWidth * devicePixelRatio, canvas.clientHeight * devicePixelRatio].map(Math.round);
  Object.assign(canvas, { width, height });
  const context = canvas.getContext('2d');
  const scale = Math.min(width / tile.width, height / tile.height);
  const [left, top] = [(width - scale * tile.width) / 2, (height - scale * tile.height) / 2];
  for (const layer of [picture, tint]) if (layer) context.drawImage(layer, left, top, scale * tile.width, scale * tile.height);
  // Pixel (0, 0) of an answer is the centre of the top-left pixel.
  const points = tile.joints.map(({ px: [x, y] }) => [left + (x + 0.5) * scale, top + (y + 0.5) * scale]);
  const radius = Math.max(4 * devicePixelRatio, (scale * tile.width) / 80);
  context.lineJoin = context.lineCap = 'round';
  for (const [style, share] of [['#141418', 0.75], ['#f5f5f5', 0.4]]) {
    context.strokeStyle = style;
    context.lineWidth = share * radius;
    context.beginPath();
    points.forEach(([x, y]) => context.lineTo(x, y));
    context.stroke();
  }
  points.forEach(([x, y], joint) => {
    for (const [style, share] of [['#141418', 1], [colour(joint), 0.75]]) {
      context.fillStyle = style;
      context.beginPath();
      context.arc(x, y, share * radius, 0, 2 * Math.PI);
      context.fill();
    }
  });
  const robot = cameras[index].robot.toUpperCase();
  const words = { found: `${robot} found`, not_found: 'no robot', invalid: 'no sensible answer' };
  const nearest = Math.min(...tile.joints.map(({ xyz_m }) => Math.hypot(...xyz_m)));
  const caption = article.querySelector('.caption');
  caption.textContent = words[tile.status] + (tile.joints.length > 0 ? ` · nearest joint ${nearest.toFixed(2)} m` : '');
  caption.className = `caption ${tile.status}`;
  caption.hidden = false;
  article.querySelector('.hint').hidden = true;
}

// What is not as it looks is veiled: pictures of the past are not taken for the present.
function showConditions() {
  const now = performance.now();
  views.forEach(({ article, tile, acquired }, index) => {
    const condition = conditions[index];
    const label = article.querySelector('.condition');
    label.textContent = CONDITIONS[condition];
    label.className = `condition ${condition}`;
    const age = now - acquired;
    const veil = article.querySelector('.veil');
    const why = paused ? 'paused' : lost ? 'no connection' : condition === 'ended' ? 'ended' : `${Math.round(age / 1000)} s old`;
    veil.textContent = why;
    veil.hidden = !tile || !(paused || lost || condition === 'ended' || age > OLD);
  });
}

function showRates(statistics) {
  const rate = (value) => value.toFixed(value < 9.95 ? 1 : 0);
  const age = (ms) => (ms === null ? '–' : ms < 1000 ? `${ms.toFixed(0)} ms` : `${(ms / 1000).toFixed(1)} s`);
  statistics.forEach(({ answers_per_s, frames_per_s, age_p50_ms, age_p99_ms, dropped }, index) => {
    const shown = { answers: rate(answers_per_s), frames: rate(frames_per_s), p50: age(age_p50_ms), p99: age(age_p99_ms), dropped };
    for (const [name, text] of Object.entries(shown)) {
      views[index].article.querySelector(`[data-rate=${name}]`).textContent = text;
    }
  });
  const all = statistics.reduce((sum, { answers_per_s }) => sum + answers_per_s, 0);
  const count = cameras.length === 1 ? '1 camera' : `${cameras.length} cameras`;
  $('rate').textContent = `${count} · ${rate(all)}/s`;
  showConnection();
}

// --- in space

// From a camera's optical frame, and from the common frame, to what the scene has: right, up, towards the viewer.
const FROM_OPTICAL = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0]];
const fromCommon = ([x, y, z]) => [x, z, y.map((value) => -value)];

function showSpace(isAnother) {
  const shown = together ? cameras.map((_, index) => index).filter((index) => cameras[index].common_from_camera) : [chosen];
  const parts = shown.filter((index) => views[index]?.tile).map((index) => {
    const { tile } = views[index];
    const { name, common_from_camera: common } = cameras[index];
    const pose = together ? fromCommon(common) : FROM_OPTICAL;
    return {
      name,
      pose,
      colour: CAMERA_COLOURS[index % CAMERA_COLOURS.length],
      size: [tile.width, tile.height],
      intrinsics: tile,
      joints: tile.joints.map(({ xyz_m }, joint) => ({ at: place(pose, xyz_m), colour: colour(joint) })),
    };
  });
  const lowest = Math.min(-0.3, ...parts.flatMap(({ joints }) => joints.map(({ at }) => at[1])));
  space.show({ floor: together ? 0 : lowest, rings: !together, cameras: parts }, isAnother);
  const joints = (!together && views[chosen]?.tile?.joints) || [];
  $('positions').hidden = joints.length === 0;
  $('positions').tBodies[0].replaceChildren(...joints.map(({ name, xyz_m }, index) => {
    const dot = document.createElement('i');
    dot.style.background = colour(index);
    const row = document.createElement('tr');
    for (const text of [name.replaceAll('_', ' '), ...[...xyz_m, Math.hypot(...xyz_m)].map((v) => v.toFixed(2))]) {
      row.insertCell().textContent = text;
    }
    row.cells[0].prepend(dot);
    return row;
  }));
}

$('which').addEventListener('change', ({ target: { value } }) => choose(value === 'all' ? chosen : Number(value), value === 'all'));

// --- alarms

function showAlarms(next) {
  alarms = [...next];
  // The worst first.
  alarms.sort((a, b) => ALARM_STATES.indexOf(b.state) - ALARM_STATES.indexOf(a.state));
  const items = alarms.map(({ rule, camera, state, distance_m, reason, at_ms }) => {
    const item = document.createElement('li');
    item.className = state;
    const icon = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
    icon.setAttribute('viewBox', '0 0 24 24');
    icon.setAttribute('aria-hidden', 'true');
    const path = document.createElementNS('http://www.w3.org/2000/svg', 'path');
    path.setAttribute('d', ALARM_ICONS[state]);
    icon.append(path);
    const where = camera === null || cameras[camera].name === rule ? '' : ` · ${cameras[camera].name}`;
    const why = reason ?? (distance_m === null ? '' : `at ${distance_m.toFixed(2)} m`);
    item.append(icon, element('strong', ALARM_WORDS[state]), clock(at_ms));
    item.append(element('span', `${rule}${where}${why && `, ${why}`}`, 'rule'));
    return item;
  });
  $('alarms').querySelector('ul').replaceChildren(...items);
  $('alarms').hidden = items.length === 0;
  const theWorst = alarms.filter(({ state }) => state === worst());
  say('spoken', theWorst.map(({ rule, state }) => `${ALARM_WORDS[state]}: ${rule}`).join(', '));
  showTitle();
}

function worst() {
  return ALARM_STATES[Math.max(0, ...alarms.map(({ state }) => ALARM_STATES.indexOf(state)))];
}

function showTitle() {
  const state = worst();
  document.body.className = state;
  document.title = state === 'clear' ? 'whereabot' : `${ALARM_WORDS[state].toUpperCase()} · whereabot`;
}

// Without news nothing is clear.
function doubtAlarms(reason) {
  showAlarms(toldAlarms.map((alarm) => ({ ...alarm, state: 'unknown', at_ms: Date.now(), reason })));
}

function element(tag, text, className = '') {
  return Object.assign(document.createElement(tag), { textContent: text, className });
}

function clock(ms) {
  const at = new Date(ms);
  const time = element('time', at.toLocaleTimeString([], { hour12: false }));
  return Object.assign(time, { dateTime: at.toISOString() });
}

// Seconds between the tones of a state, their frequency in Hz, and how many there are.
const TONES = { unknown: [2, 330, 2], warn: [1, 660, 1], stop: [0.4, 990, 2] };
let audio;
let nextTone = 0;

function setSound(on) {
  $('sound').setAttribute('aria-pressed', on);
  localStorage.setItem('sound', on);
  audio ??= on ? new AudioContext() : undefined;
  audio?.[on ? 'resume' : 'suspend']();
}

function sound() {
  const tone = TONES[worst()];
  if (!tone || paused || audio?.state !== 'running') return;
  const [period, frequency, count] = tone;
  const now = audio.currentTime;
  if (now < nextTone) return;
  nextTone = now + period;
  for (let index = 0; index < count; index++) {
    const from = now + 0.16 * index;
    const gain = new GainNode(audio, { gain: 0 });
    // A tone that jumps clicks.
    gain.gain.setValueAtTime(0, from);
    gain.gain.linearRampToValueAtTime(0.25, from + 0.01);
    gain.gain.setValueAtTime(0.25, from + 0.11);
    gain.gain.linearRampToValueAtTime(0, from + 0.13);
    const oscillator = new OscillatorNode(audio, { frequency, type: 'triangle' });
    oscillator.connect(gain).connect(audio.destination);
    oscillator.start(from);
    oscillator.stop(from + 0.14);
  }
}

$('sound').addEventListener('click', () => setSound($('sound').getAttribute('aria-pressed') !== 'true'));
// A browser lets no page be heard before its user has done something there.
if (localStorage.getItem('sound') === 'true') {
  for (const event of ['pointerdown', 'keydown']) addEventListener(event, () => setSound(true), { once: true });
}

// --- events

const MOST_EVENTS = 100;
let eventCount = 0;

function showEvent({ at_ms, camera, kind, text }) {
  const item = document.createElement('li');
  item.className = kind;
  const words = element('span', text);
  if (camera !== null) words.prepend(element('b', cameras[camera].name), ' ');
  item.append(clock(at_ms), words);
  if (eventCount++ === 0) $('events').replaceChildren();
  $('events').prepend(item);
  if ($('events').children.length > MOST_EVENTS) $('events').lastElementChild.remove();
}

// --- whether anything comes

// A screen reader says what is written, be it what was there before.
function say(id, text) {
  if ($(id).textContent !== text) $(id).textContent = text;
}

function notice(text) {
  say('notice', text ?? '');
  $('notice').hidden = !text;
}

function setLost(isLost) {
  if (isLost && !lost) doubtAlarms('no connection');
  if (isLost) notice('No connection to whereabot: what is shown is old. It is tried again every second.');
  lost = isLost;
  showConnection();
  showConditions();
}

function showConnection() {
  say('connected', paused ? 'paused' : lost ? 'no connection' : 'connected');
  // Rates are seen in place of the word: spoken every second, they would drown all else.
  $('rate').hidden = paused || lost || !$('rate').textContent;
  $('connected').className = $('rate').hidden ? '' : 'spoken';
  $('connection').className = paused ? '' : lost ? 'lost' : 'live';
}

$('pause').addEventListener('click', () => {
  paused = !paused;
  $('pause').setAttribute('aria-pressed', paused);
  $('pause').querySelector('span').textContent = paused ? 'Go on' : 'Pause';
  if (paused) {
    asking?.abort();
    doubtAlarms('paused');
    showConnection();
    showConditions();
  } else {
    // Until the next answer nothing is known.
    lost = true;
  }
});

setInterval(() => {
  showConditions();
  sound();
}, 200);
follow();
