// SPDX-License-Identifier: Apache-2.0
// The 3-D view of the report: cloud, pipes and cameras; a click on a pipe shows its row, a click on a row its pipe.
(() => {
"use strict";
const frame = document.getElementById("view");
const rows = [...document.querySelectorAll(".pipe")];
const panel = document.getElementById("selected");
const read = (id) => JSON.parse(document.getElementById(id).textContent);
const {pipes, cameras, boards, planned, previous} = read("view-data");

let renderer;
try {
  renderer = new THREE.WebGLRenderer({antialias: true});
} catch {
  return; // no WebGL: the still picture stays
}

const CHOSEN = new THREE.Color(0.01, 0.01, 0.01); // no class of the palette is black; the label names it besides
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xf7f8fa);
scene.add(new THREE.HemisphereLight(0xffffff, 0x888888, 2.2));
const sun = new THREE.DirectionalLight(0xffffff, 1.2);
scene.add(sun, sun.target);
const camera = new THREE.PerspectiveCamera(50, 1, 0.02, 2000);
camera.up.set(0, 0, 1);
const controls = new THREE.OrbitControls(camera, renderer.domElement);
const label = document.createElement("div");
label.className = "label";
label.hidden = true;

// ---- what is drawn, one draw call a kind
function bytes(id) {
  const text = atob(document.getElementById(id).textContent);
  const data = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) data[i] = text.charCodeAt(i);
  return data;
}

function cloud() {
  const box = read("cloud-box");
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Uint16Array(bytes("cloud-points").buffer), 3, true));
  geometry.setAttribute("color", new THREE.BufferAttribute(bytes("cloud-colors"), 3, true));
  const points = new THREE.Points(geometry, new THREE.PointsMaterial({size: 1.6, sizeAttenuation: false, vertexColors: true}));
  points.position.set(...box.low);
  points.scale.set(...box.size);
  points.frustumCulled = false;
  // The points on the pipes come last: they are drawn where the pipes are not.
  points.userData = box;
  geometry.setDrawRange(0, box.off_pipes);
  return box.count ? points : null;
}

function cylinders(list, material, color) {
  if (!list.length) return null;
  const mesh = new THREE.InstancedMesh(new THREE.CylinderGeometry(1, 1, 1, 24), material, list.length);
  const y = new THREE.Vector3(0, 1, 0);
  list.forEach((pipe, number) => {
    const start = new THREE.Vector3(...pipe.start), end = new THREE.Vector3(...pipe.end);
    const along = end.clone().sub(start);
    const turn = new THREE.Quaternion().setFromUnitVectors(y, along.clone().normalize());
    const lifted = pipe.radius + 0.004; // m, above the points that it was fitted to
    mesh.setMatrixAt(number, new THREE.Matrix4().compose(start.add(end).multiplyScalar(0.5), turn,
      new THREE.Vector3(lifted, along.length(), lifted)));
    mesh.setColorAt(number, color(pipe));
  });
  mesh.frustumCulled = false;
  return mesh;
}

function frusta() {
  const corners = [[-0.67, -0.5, 1], [0.67, -0.5, 1], [0.67, 0.5, 1], [-0.67, 0.5, 1]];
  const places = [];
  let last = null;
  for (const pose of cameras) { // rows of map_from_camera
    const at = (p) => [0, 1, 2].map((row) => 0.08 * (pose[4 * row] * p[0] + pose[4 * row + 1] * p[1] + pose[4 * row + 2] * p[2]) + pose[4 * row + 3]);
    const eye = at([0, 0, 0]), base = corners.map(at);
    base.forEach((corner, number) => places.push(...eye, ...corner, ...corner, ...base[(number + 1) % 4]));
    if (last) places.push(...last, ...eye);
    last = eye;
  }
  if (!places.length) return null;
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places), 3));
  const lines = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({color: 0xb35a00}));
  lines.frustumCulled = false;
  return lines;
}

function plates() { // the edge and the circles of each board
  const places = boards.flatMap(({lines}) => lines).flatMap((line) =>
    line.flatMap((corner, number) => [...corner, ...line[(number + 1) % line.length]]));
  if (!places.length) return null;
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(places), 3));
  const lines = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({color: 0x101010}));
  lines.frustumCulled = false;
  return lines;
}

const own = (pipe) => new THREE.Color().setRGB(...pipe.color, "srgb");
const solid = cylinders(pipes, new THREE.MeshLambertMaterial(), own);
const ghosts = cylinders(previous, new THREE.MeshBasicMaterial({transparent: true, opacity: 0.35}), () => new THREE.Color(0.35, 0.35, 0.4));
const plans = cylinders(planned, new THREE.MeshBasicMaterial({transparent: true, opacity: 0.3}), own);
const layers = {"cloud": cloud(), "pipes": solid, "cameras": frusta(), "boards": plates(), "planned, not installed": plans, "pipes of the survey before": ghosts};
for (const [name, object] of Object.entries(layers)) {
  if (!object) continue;
  scene.add(object);
  const box = document.createElement("input");
  box.type = "checkbox";
  box.checked = true;
  box.addEventListener("change", () => {
    object.visible = box.checked;
    layers.cloud?.geometry.setDrawRange(0, solid?.visible ? layers.cloud.userData.off_pipes : layers.cloud.userData.count);
    draw();
  });
  const text = document.createElement("label");
  text.append(box, ` ${name}`);
  document.getElementById("layers").append(text);
}

// ---- where the camera stands
const ends = pipes.flatMap((pipe) => [new THREE.Vector3(...pipe.start), new THREE.Vector3(...pipe.end)]);
const edges = boards.flatMap(({lines}) => lines[0].map((corner) => new THREE.Vector3(...corner)));
const wanted = ends.length ? [...ends, ...edges] : cameras.map((pose) => new THREE.Vector3(pose[3], pose[7], pose[11]));
const centre = new THREE.Box3().setFromPoints(wanted).getCenter(new THREE.Vector3());
function home() {
  const eye = new THREE.Vector3(0.4, -1, 0.35);
  if (cameras.length) {
    const mean = new THREE.Vector3();
    cameras.forEach((pose) => mean.add(new THREE.Vector3(pose[3], pose[7], pose[11])));
    mean.divideScalar(cameras.length).sub(centre).setZ(0);
    if (mean.length() > 0.1) eye.copy(mean.normalize()).setZ(0.35);
  }
  controls.target.copy(centre);
  // As near as all that is wanted stays in view, with a margin of a tenth, but no nearer than a metre.
  eye.normalize();
  const half = Math.tan(camera.fov / 2 * Math.PI / 180) / 1.1;
  const right = new THREE.Vector3().crossVectors(camera.up, eye).normalize(), up = new THREE.Vector3().crossVectors(eye, right);
  const distance = Math.max(1, ...wanted.map((point) => {
    const from = point.clone().sub(centre);
    return from.dot(eye) + Math.max(Math.abs(from.dot(right)) / camera.aspect, Math.abs(from.dot(up))) / half;
  }));
  camera.position.copy(centre).addScaledVector(eye, distance);
  controls.update();
}

// ---- drawn when something has changed, and then once
let waiting = false;
function draw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    sun.position.copy(camera.position);
    sun.target.position.copy(controls.target);
    renderer.render(scene, camera);
    placeLabel();
  });
}

function fit() {
  const width = frame.clientWidth, height = Math.round(Math.min(0.75 * width, 0.7 * window.innerHeight));
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  renderer.setSize(width, height);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  draw();
}

// ---- one pipe is chosen at a time
let chosen = -1;
const middle = (pipe) => new THREE.Vector3(...pipe.start).add(new THREE.Vector3(...pipe.end)).multiplyScalar(0.5);
function placeLabel() {
  label.hidden = chosen < 0;
  if (label.hidden) return;
  const place = middle(pipes[chosen]).project(camera);
  const x = (place.x + 1) / 2 * frame.clientWidth, y = (1 - place.y) / 2 * renderer.domElement.clientHeight;
  label.style.transform = `translate(${Math.round(x + 8)}px, ${Math.round(y - 30)}px)`;
}

function choose(number) {
  if (chosen >= 0) {
    solid.setColorAt(chosen, own(pipes[chosen]));
    rows[chosen].classList.remove("chosen");
    rows[chosen].removeAttribute("aria-current");
  }
  chosen = number;
  if (chosen >= 0) {
    const pipe = pipes[chosen];
    solid.setColorAt(chosen, CHOSEN);
    rows[chosen].classList.add("chosen");
    rows[chosen].setAttribute("aria-current", "true");
    label.textContent = `${pipe.id} ${pipe.letter}`;
    const link = document.createElement("a");
    link.href = `#${rows[chosen].id}`;
    link.textContent = pipe.id;
    panel.replaceChildren(link, ` ${pipe.letter} ${pipe.class ?? "no planned class"}, ${pipe.length.toFixed(2)} m`);
    const photograph = rows[chosen].querySelector(".photographs img");
    if (photograph) panel.append(photograph.cloneNode());
  } else {
    panel.replaceChildren();
  }
  solid.instanceColor.needsUpdate = true;
  draw();
}

// From the view to the row: beside the view where there is room, else the panel below it has the photograph.
function chooseInView(number) {
  choose(number);
  if (number >= 0 && beside()) rows[number].scrollIntoView({block: "nearest"});
}
const beside = () => matchMedia("(min-width: 1100px)").matches;

// From the row to the view, which turns around the pipe.
function chooseInRow(number) {
  choose(number);
  const pipe = pipes[number], offset = camera.position.clone().sub(controls.target);
  controls.target.copy(middle(pipe));
  camera.position.copy(controls.target).add(offset.setLength(Math.min(offset.length(), Math.max(1.5, 2.5 * pipe.length))));
  controls.update();
  if (!beside()) frame.scrollIntoView({block: "nearest"});
}

function pipeAt(x, y) {
  const rect = renderer.domElement.getBoundingClientRect();
  const ray = new THREE.Raycaster();
  ray.setFromCamera(new THREE.Vector2((x - rect.left) / rect.width * 2 - 1, 1 - (y - rect.top) / rect.height * 2), camera);
  return solid && solid.visible ? ray.intersectObject(solid)[0]?.instanceId ?? -1 : -1;
}

// A click is a press and a release at one place: anything longer turns the view. A finger hits a pipe within 12 px.
let pressed = null;
renderer.domElement.addEventListener("pointerdown", (event) => { pressed = event.isPrimary ? [event.clientX, event.clientY] : null; });
renderer.domElement.addEventListener("pointerup", (event) => {
  if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 6) return;
  const around = event.pointerType === "touch" ? [[0, 0], [6, 0], [-6, 0], [0, 6], [0, -6], [12, 0], [-12, 0], [0, 12], [0, -12]] : [[0, 0]];
  chooseInView(around.map(([x, y]) => pipeAt(event.clientX + x, event.clientY + y)).find((number) => number >= 0) ?? -1);
});

const turned = (azimuth, height) => {
  const offset = camera.position.clone().sub(controls.target);
  offset.applyAxisAngle(new THREE.Vector3(0, 0, 1), azimuth);
  const side = new THREE.Vector3().crossVectors(offset, camera.up).normalize();
  const tilted = offset.clone().applyAxisAngle(side, height);
  camera.position.copy(controls.target).add(Math.abs(tilted.z) < 0.99 * tilted.length() ? tilted : offset);
};
const nearer = (factor) => camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
const KEYS = {
  ArrowLeft: () => turned(0.1, 0), ArrowRight: () => turned(-0.1, 0), ArrowUp: () => turned(0, 0.1), ArrowDown: () => turned(0, -0.1),
  "+": () => nearer(0.85), "=": () => nearer(0.85), "-": () => nearer(1 / 0.85), Home: home,
  n: () => pipes.length && chooseInView((chosen + 1) % pipes.length),
  p: () => pipes.length && chooseInView((chosen + pipes.length - (chosen < 0 ? 0 : 1)) % pipes.length),
  Enter: () => { if (chosen >= 0) { rows[chosen].scrollIntoView({block: "center"}); rows[chosen].focus({preventScroll: true}); } },
  Escape: () => choose(-1),
};
frame.addEventListener("keydown", (event) => {
  const act = event.ctrlKey || event.metaKey || event.altKey ? null : KEYS[event.key];
  if (!act) return;
  event.preventDefault();
  act();
  controls.update();
  draw();
});
rows.forEach((row, number) => {
  row.addEventListener("click", () => { if (!String(getSelection())) chooseInRow(number); });
  row.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    chooseInRow(number);
  });
});

frame.append(renderer.domElement, label);
document.getElementById("still").style.display = "none";
controls.addEventListener("change", draw);
addEventListener("resize", fit);
fit();
home();
draw();
// For tests: where a pipe is on the screen, and what a frame costs.
window.reportView = {
  chosen: () => chosen,
  place: (number) => {
    const at = middle(pipes[number]).project(camera), rect = renderer.domElement.getBoundingClientRect();
    return [rect.left + (at.x + 1) / 2 * rect.width, rect.top + (1 - at.y) / 2 * rect.height];
  },
  pipeAt,
  drawn: () => { renderer.render(scene, camera); return {...renderer.info.render}; },
};
})();
