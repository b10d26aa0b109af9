// Plays the episodes of the page. The data's format is that of `Document` in document.rs.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);

// The view: seconds and metres, z is up.
const DISTANCE = 3.8;
const ELEVATION = 14 * Math.PI / 180;
const TURN = 35 * Math.PI / 180;
// How far the reference stands beside the humanoid, m.
const ASIDE = 1.0;
const GHOST_COLOUR = 0x59bfff;
// Side of the floor that is drawn of a plane, and of one of its tiles, m. A plane has no end for contacts.
const FLOOR = 160;
const TILE = 1;
const TILE_COLOURS = { light: ["#b3bdc7", "#a2adb8"], dark: ["#55616d", "#4a5560"] };
// How long the end is shown before an episode begins again, s.
const HOLD = 0.8;
// Distinct also for most people who are colour-blind (Okabe and Ito, 2008).
const STRIP_COLOURS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00"];

// ---------------------------------------------------------------- data

// Poses of frames, which are read one by one.
class Poses {
  constructor(poses) {
    const bytes = Uint8Array.from(atob(poses.data), (letter) => letter.charCodeAt(0));
    this.view = new DataView(bytes.buffer);
    this.bodies = poses.bodies;
    this.low = poses.low;
    this.range = poses.high.map((high, axis) => high - poses.low[axis]);
    this.frames = poses.bodies ? bytes.length / (14 * poses.bodies) : 0;
  }

  read(frame, body, position, rotation) {
    const at = 14 * (frame * this.bodies + body);
    const place = (axis) => this.low[axis] + (this.view.getUint16(at + 2 * axis, true) / 65535) * this.range[axis];
    const part = (index) => this.view.getInt16(at + 6 + 2 * index, true) / 32767;
    position.set(place(0), place(1), place(2));
    rotation.set(part(1), part(2), part(3), part(0)).normalize();
  }
}

// The sum of all terms of each step, then each term.
function rewardLines(episode) {
  const steps = episode.rewards.length ? episode.rewards[0].length : 0;
  const sums = Array.from({ length: steps }, (_, step) => episode.rewards.reduce((sum, term) => sum + term[step], 0));
  return [sums, ...episode.rewards];
}

// ---------------------------------------------------------------- shapes

function geometryOf(shape) {
  const [a, b, c] = shape.size;
  switch (shape.form) {
    case "sphere":
      return new THREE.SphereBufferGeometry(a, 24, 16);
    case "ellipsoid":
      return new THREE.SphereBufferGeometry(1, 24, 16).scale(a, b, c);
    case "capsule": {
      // Half a circle at each end, turned about the axis.
      const arc = (from, offset) => Array.from({ length: 9 }, (_, step) => {
        const angle = from + (step / 8) * Math.PI / 2;
        return new THREE.Vector2(a * Math.cos(angle), offset + a * Math.sin(angle));
      });
      const outline = [...arc(-Math.PI / 2, -b), ...arc(0, b)];
      return new THREE.LatheBufferGeometry(outline, 24).rotateX(Math.PI / 2);
    }
    case "cylinder":
      return new THREE.CylinderBufferGeometry(a, a, 2 * b, 24).rotateX(Math.PI / 2);
    case "box":
      return new THREE.BoxBufferGeometry(2 * a, 2 * b, 2 * c);
    default:
      return new THREE.PlaneBufferGeometry(FLOOR, FLOOR);
  }
}

function tiles() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const paint = canvas.getContext("2d");
  const [one, other] = TILE_COLOURS[window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"];
  paint.fillStyle = one;
  paint.fillRect(0, 0, 64, 64);
  paint.fillStyle = other;
  paint.fillRect(0, 0, 32, 32);
  paint.fillRect(32, 32, 32, 32);
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(FLOOR / (2 * TILE), FLOOR / (2 * TILE));
  texture.anisotropy = 8;
  return texture;
}

function meshOf(shape, ghost) {
  const [red, green, blue, opacity] = shape.colour;
  const material = new THREE.MeshStandardMaterial({ roughness: 0.75, metalness: 0 });
  if (shape.form === "plane") {
    material.map = tiles();
  } else if (ghost) {
    Object.assign(material, { transparent: true, opacity: 0.35, depthWrite: false });
    material.color.set(GHOST_COLOUR);
  } else {
    material.color.setRGB(red, green, blue);
    Object.assign(material, { transparent: opacity < 1, opacity });
  }
  const mesh = new THREE.Mesh(geometryOf(shape), material);
  mesh.position.fromArray(shape.position);
  const [w, x, y, z] = shape.rotation;
  mesh.quaternion.set(x, y, z, w);
  mesh.castShadow = !ghost && shape.form !== "plane";
  mesh.receiveShadow = !ghost;
  return mesh;
}

// A scene's shapes in groups: one for the world, one for each body, and one for each body of the reference.
function build(scene, episode) {
  const all = new THREE.Group();
  const groups = (count) => Array.from({ length: count }, () => {
    const group = new THREE.Group();
    all.add(group);
    return group;
  });
  const bodies = groups(episode.poses.bodies);
  const ghosts = groups(episode.reference ? episode.reference.bodies : 0);
  const floors = [];
  for (const shape of scene.shapes) {
    const mesh = meshOf(shape, false);
    (shape.body === null ? all : bodies[shape.body]).add(mesh);
    if (shape.form === "plane") floors.push(mesh);
    if (shape.body !== null && shape.body < ghosts.length) ghosts[shape.body].add(meshOf(shape, true));
  }
  const target = new THREE.Mesh(
    new THREE.CylinderBufferGeometry(0.25, 0.25, 0.02, 40).rotateX(Math.PI / 2),
    new THREE.MeshStandardMaterial({ color: 0xd13b2f }),
  );
  target.visible = episode.targets.length > 0;
  all.add(target);
  return { all, bodies, ghosts, floors, target };
}

// ---------------------------------------------------------------- the view

function openView() {
  const canvas = element("view");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = THREE.PCFSoftShadowMap;
  const scene = new THREE.Scene();
  scene.add(new THREE.HemisphereLight(0xffffff, 0x9aa0a8, 0.85));
  const sun = new THREE.DirectionalLight(0xffffff, 0.5);
  sun.castShadow = true;
  sun.shadow.mapSize.set(2048, 2048);
  Object.assign(sun.shadow.camera, { left: -4, right: 4, top: 4, bottom: -4, near: 1, far: 20 });
  sun.shadow.bias = -0.0005;
  scene.add(sun, sun.target);
  const camera = new THREE.PerspectiveCamera(45, 1, 0.05, 200);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, canvas);
  controls.maxPolarAngle = Math.PI / 2 - 0.02;
  controls.enableKeys = false;
  controls.minDistance = 0.5;
  controls.maxDistance = 40;
  return { renderer, scene, sun, camera, controls, canvas };
}

class Player {
  constructor(view) {
    this.view = view;
    this.step = 0;
    this.playing = false;
    this.last = null;
  }

  choose(index) {
    const episode = data.episodes[index];
    const { scene } = this.view;
    if (this.built) scene.remove(this.built.all);
    this.episode = episode;
    this.poses = new Poses(episode.poses);
    this.reference = episode.reference ? new Poses(episode.reference) : null;
    this.lines = rewardLines(episode);
    this.end = episode.steps;
    this.built = build(data.scenes[episode.scene], episode);
    scene.add(this.built.all);
    element("note").textContent = episode.note;
    element("ghost-label").hidden = !this.reference;
    element("slider").max = this.end;
    this.step = 0;
    this.look();
    this.show();
  }

  // Behind the right shoulder, as in a film. The humanoid's own z points forward.
  look() {
    const root = { position: new THREE.Vector3(), rotation: new THREE.Quaternion() };
    this.poses.read(0, 0, root.position, root.rotation);
    const forward = new THREE.Vector3(0, 0, 1).applyQuaternion(root.rotation);
    const azimuth = Math.atan2(forward.y, forward.x) + TURN;
    const { camera, controls } = this.view;
    controls.target.set(root.position.x, root.position.y, Math.max(root.position.z - 0.1, 0.5));
    camera.position.set(Math.cos(azimuth), Math.sin(azimuth), 0).multiplyScalar(-Math.cos(ELEVATION));
    camera.position.z = Math.sin(ELEVATION);
    camera.position.multiplyScalar(DISTANCE).add(controls.target);
    this.aside = new THREE.Vector3(ASIDE * Math.sin(azimuth), -ASIDE * Math.cos(azimuth), 0);
    controls.update();
  }

  // The frames before and after the present time, and how far it is from one to the other, 0 to 1. Frames are `every` steps
  // apart, but for the last one, which is at the end.
  between(frames) {
    const { every } = this.episode;
    const before = Math.min(Math.floor(this.step / every), Math.max(frames - 2, 0));
    const [from, to] = [before * every, Math.min((before + 1) * every, this.end)];
    const share = to > from ? Math.min((this.step - from) / (to - from), 1) : 0;
    return [before, Math.min(before + 1, frames - 1), share];
  }

  // Puts groups into the poses at the present time.
  place(groups, poses, offset) {
    const [before, after, share] = this.between(poses.frames);
    const [position, rotation] = [new THREE.Vector3(), new THREE.Quaternion()];
    groups.forEach((group, body) => {
      poses.read(before, body, group.position, group.quaternion);
      poses.read(after, body, position, rotation);
      group.position.lerp(position, share);
      group.quaternion.slerp(rotation, share);
      if (offset) group.position.add(offset);
    });
  }

  show() {
    const { built, view, episode } = this;
    this.place(built.bodies, this.poses, null);
    const mode = element("ghost").value;
    for (const ghost of built.ghosts) ghost.visible = mode !== "off";
    if (this.reference) this.place(built.ghosts, this.reference, mode === "beside" ? this.aside : null);
    if (episode.targets.length) {
      const [frame] = this.between(this.poses.frames);
      const [x, y] = episode.targets[Math.min(frame, episode.targets.length - 1)];
      built.target.position.set(x, y, 0.01);
    }
    const root = built.bodies[0].position;
    if (element("follow").checked) {
      const move = new THREE.Vector3(root.x - view.controls.target.x, root.y - view.controls.target.y, 0);
      view.controls.target.add(move);
      view.camera.position.add(move);
    }
    // By whole tiles, so that the floor seems to stand still.
    for (const floor of built.floors) {
      floor.position.x = Math.round(root.x / (2 * TILE)) * 2 * TILE;
      floor.position.y = Math.round(root.y / (2 * TILE)) * 2 * TILE;
    }
    view.sun.target.position.copy(root);
    view.sun.position.copy(root).add(new THREE.Vector3(2, -3, 7));
    this.write();
    this.draw();
  }

  write() {
    const seconds = (steps) => (steps * data.step).toFixed(2);
    element("time").textContent =
      `step ${Math.floor(this.step)} of ${this.end} · ${seconds(this.step)} of ${seconds(this.end)} s`;
    element("slider").value = this.step;
    element("play").textContent = this.playing ? "Pause" : "Play";
    element("play").setAttribute("aria-pressed", this.playing);
    strips.forEach((strip) => strip.show(this));
  }

  draw() {
    const { renderer, scene, camera, canvas } = this.view;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    const ratio = renderer.getPixelRatio();
    if (canvas.width !== Math.floor(width * ratio) || canvas.height !== Math.floor(height * ratio)) {
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    renderer.render(scene, camera);
  }

  seek(step) {
    this.step = Math.min(Math.max(step, 0), this.end);
    this.show();
  }

  play(playing) {
    this.playing = playing;
    this.last = null;
    this.held = 0;
    if (playing && this.step >= this.end) this.step = 0;
    this.write();
    cancelAnimationFrame(this.request);
    if (playing) this.request = requestAnimationFrame((now) => this.tick(now));
  }

  tick(now) {
    const passed = this.last === null ? 0 : (now - this.last) / 1000;
    this.last = now;
    if (this.step < this.end) {
      this.step = Math.min(this.step + (passed / data.step) * Number(element("speed").value), this.end);
    } else if ((this.held += passed) > HOLD) {
      [this.step, this.held] = [0, 0];
    }
    this.show();
    this.request = requestAnimationFrame((next) => this.tick(next));
  }
}

// ---------------------------------------------------------------- the rewards

class Strip {
  constructor(name, term, colour) {
    this.term = term;
    this.colour = colour;
    // The same scale for all episodes of the page. It has 0.
    [this.low, this.high] = [0, 0];
    for (const episode of data.episodes) {
      for (const reward of rewardLines(episode)[term]) {
        this.low = Math.min(this.low, reward);
        this.high = Math.max(this.high, reward);
      }
    }
    this.canvas = document.createElement("canvas");
    this.value = document.createElement("span");
    this.value.className = "value";
    const label = document.createElement("span");
    const range = document.createElement("small");
    range.textContent = ` ${Number(this.low.toPrecision(2))} to ${Number(this.high.toPrecision(2))}`;
    label.append(name, range);
    element("strips").append(label, this.canvas, this.value);
    const seek = (event) => {
      if (event.buttons) player.seek((event.offsetX / this.canvas.clientWidth) * player.end);
    };
    this.canvas.addEventListener("pointerdown", seek);
    this.canvas.addEventListener("pointermove", seek);
  }

  show(player) {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    const line = player.lines[this.term];
    if (canvas.width !== width || canvas.height !== height || this.drawn !== line) {
      [canvas.width, canvas.height] = [width, height];
      this.picture = this.paint(line, player.end, width, height);
      this.drawn = line;
    }
    const paint = canvas.getContext("2d");
    paint.clearRect(0, 0, width, height);
    if (width && height) paint.drawImage(this.picture, 0, 0);
    paint.fillStyle = getComputedStyle(document.body).color;
    paint.fillRect(Math.min((player.step / (player.end || 1)) * width, width - ratio), 0, Math.max(ratio, 1), height);
    // The reward of a step is known when the step is over.
    const step = Math.min(Math.floor(player.step), line.length) - 1;
    this.value.textContent = step < 0 ? "" : line[step].toFixed(3);
  }

  paint(line, end, width, height) {
    const picture = document.createElement("canvas");
    [picture.width, picture.height] = [Math.max(width, 1), Math.max(height, 1)];
    const paint = picture.getContext("2d");
    paint.fillStyle = this.colour;
    paint.globalAlpha = 0.85;
    const row = (reward) => (height * (this.high - reward)) / (this.high - this.low || 1);
    const column = (step) => (step / (end || 1)) * width;
    paint.beginPath();
    paint.moveTo(0, row(0));
    line.forEach((reward, step) => {
      paint.lineTo(column(step), row(reward));
      paint.lineTo(column(step + 1), row(reward));
    });
    paint.lineTo(column(line.length), row(0));
    paint.fill();
    return picture;
  }
}

// ---------------------------------------------------------------- the page

let player;
const strips = [];

function fail(reason) {
  element("view").hidden = true;
  element("failure").hidden = false;
  element("failure").textContent = reason;
}

function chosen() {
  const wanted = Number.parseInt(location.hash.slice(1), 10) - 1;
  return wanted >= 0 && wanted < data.episodes.length ? wanted : 0;
}

function start() {
  document.title = data.title;
  document.querySelector("h1").textContent = data.title;
  data.episodes.forEach((episode, index) => element("episode").add(new Option(episode.name, index)));
  element("ghost").value = data.ghost;
  if (!data.episodes.length) return fail("This page has no episode.");
  try {
    player = new Player(openView());
  } catch (error) {
    return fail(`This page needs WebGL, and this browser has none (${error.message}).`);
  }
  // A single term is the reward itself.
  const names = data.terms.length > 1 ? ["reward", ...data.terms] : ["reward"];
  names.forEach((name, term) => strips.push(new Strip(name, term, STRIP_COLOURS[term % STRIP_COLOURS.length])));

  const choose = (index) => {
    element("episode").value = index;
    player.choose(index);
  };
  element("episode").addEventListener("change", (event) => {
    // The address names the episode. It is no new page to go back from.
    history.replaceState(null, "", `#${Number(event.target.value) + 1}`);
    choose(chosen());
    // The arrow keys belong to the film again.
    event.target.blur();
  });
  window.addEventListener("hashchange", () => choose(chosen()));
  element("play").addEventListener("click", () => player.play(!player.playing));
  element("slider").addEventListener("input", (event) => player.seek(Number(event.target.value)));
  element("ghost").addEventListener("change", () => player.show());
  element("follow").addEventListener("change", () => player.show());
  player.view.controls.addEventListener("change", () => player.draw());
  window.addEventListener("resize", () => player.show());
  document.addEventListener("keydown", (event) => {
    const control = event.target.matches("select, button, input:not([type=range])");
    if (control || event.repeat && event.key === " " || event.altKey || event.ctrlKey || event.metaKey) return;
    const keys = { " ": () => player.play(!player.playing) };
    keys.ArrowLeft = () => player.seek(Math.ceil(player.step) - 1);
    keys.ArrowRight = () => player.seek(Math.floor(player.step) + 1);
    if (keys[event.key]) {
      event.preventDefault();
      keys[event.key]();
    }
  });
  choose(chosen());
  player.play(!window.matchMedia("(prefers-reduced-motion: reduce)").matches);
}

start();
