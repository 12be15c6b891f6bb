// The flight in three dimensions: every run, its target as a ghost, its path, its thrusts.
(() => {
const holder = document.getElementById('scene');
if (!holder) return;
const {robot} = page;

let renderer;
try {
  renderer = new THREE.WebGLRenderer({antialias: true});
} catch (error) {
  holder.textContent = 'This browser has no WebGL, which the scene needs.';
  return;
}
renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
holder.prepend(renderer.domElement);
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xeef2f6);
scene.add(new THREE.HemisphereLight(0xffffff, 0xb4bdc8, 2.2));
const sun = new THREE.DirectionalLight(0xffffff, 1.6);
sun.position.set(-2, -3, 6);
scene.add(sun);
const grid = new THREE.GridHelper(12, 24, 0x9aa5b1, 0xc9d0d8);
grid.rotation.x = Math.PI / 2;
scene.add(grid);
const camera = new THREE.PerspectiveCamera(35, 1, 0.02, 100);
camera.up.set(0, 0, 1);
const controls = new THREE.OrbitControls(camera, renderer.domElement);

const X = new THREE.Vector3(1, 0, 0), Y = new THREE.Vector3(0, 1, 0), Z = new THREE.Vector3(0, 0, 1);
const vector = values => new THREE.Vector3(...values);

function rod(from, to, radius, material) {
  const along = to.clone().sub(from);
  const mesh = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, along.length(), 12),
    material);
  mesh.position.copy(from).addScaledVector(along, 0.5);
  mesh.quaternion.setFromUnitVectors(Y, along.normalize());
  return mesh;
}

function build(colour, opacity) {
  const paint = (value, share = 1) => new THREE.MeshLambertMaterial({
    color: value, transparent: opacity * share < 1, opacity: opacity * share,
    depthWrite: opacity * share === 1, side: THREE.DoubleSide});
  const ghost = opacity < 1, body = new THREE.Group(), main = paint(colour);
  const dark = ghost ? main : paint('#23272d'), ball = ghost ? main : paint('#f09a14');
  const top = vector(robot.ball);
  body.add(rod(vector([0, 0, -0.02]), vector([0, 0, 0.03]), 0.07, dark));
  body.add(rod(vector([0, 0, 0]), top, 0.008, dark));
  const tip = new THREE.Mesh(new THREE.SphereGeometry(robot.ball_radius, 20, 14), ball);
  tip.position.copy(top);
  body.add(tip);
  const nose = new THREE.Mesh(new THREE.ConeGeometry(0.025, 0.08, 12), ghost ? main : paint('#ffffff'));
  nose.position.set(0.10, 0, 0.01);
  nose.quaternion.setFromUnitVectors(Y, X);
  body.add(nose);
  const arms = robot.rotors.map((place, k) => {
    const end = vector(place), axis = vector(robot.axes[k]);
    body.add(rod(vector([0, 0, 0]), end.clone().addScaledVector(axis, -0.02), 0.012, main));
    const frame = new THREE.Group(), turning = new THREE.Group();
    frame.position.copy(end);
    frame.quaternion.setFromUnitVectors(X, axis);
    const disc = new THREE.Mesh(new THREE.CylinderGeometry(robot.radius, robot.radius, 0.004, 32),
      paint(colour, 0.35));
    disc.rotation.x = Math.PI / 2;
    disc.position.z = 0.012;
    turning.add(disc, rod(vector([0, 0, -0.025]), vector([0, 0, 0.02]), 0.018, dark));
    frame.add(turning);
    body.add(frame);
    let arrow = null;
    if (!ghost) {
      arrow = new THREE.Group();
      const green = new THREE.MeshLambertMaterial({color: '#12a06a'});
      const shaft = rod(vector([0, 0, 0]), Z, 0.007, green);
      const head = new THREE.Mesh(new THREE.ConeGeometry(0.02, 0.05, 12), green);
      head.quaternion.setFromUnitVectors(Y, Z);
      arrow.add(shaft, head);
      turning.add(arrow);
      arrow.userData = {shaft, head};
    }
    return {turning, arrow};
  });
  scene.add(body);
  return {body, arms};
}

const columns = list => list.map(unpacked);
const points = new THREE.Vector3(), spread = {low: [1e9, 1e9, 1e9], high: [-1e9, -1e9, -1e9]};
const flights = page.runs.map((run, index) => {
  const position = columns(run.position), quaternion = columns(run.quaternion);
  const tilt = columns(run.tilt), thrust = columns(run.thrust);
  const targets = {t: run.targets.t, pose: run.targets.pose};
  const path = [];
  for (let k = 0; k < times.length; k += Math.max(1, Math.floor(times.length / 3000))) {
    if (position[0][k] === null) continue;
    const place = position.map(axis => axis[k]);
    path.push(...place);
    place.forEach((value, axis) => {
      spread.low[axis] = Math.min(spread.low[axis], value);
      spread.high[axis] = Math.max(spread.high[axis], value);
    });
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(new Float32Array(path), 3));
  const line = new THREE.Line(geometry, new THREE.LineBasicMaterial(
    {color: run.colour, transparent: true, opacity: 0.45}));
  scene.add(line);
  return {position, quaternion, tilt, thrust, targets, line, robot: build(run.colour, 1),
          ghost: targets.t.length ? build(run.colour, 0.22) : null, index};
});

function latest(list, now) {
  let low = 0, high = list.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (list[middle] <= now + 1e-6) low = middle + 1; else high = middle;
  }
  return low - 1;
}

const told = document.getElementById('errors');
let due = true;
function place(now) {
  const k = Math.min(times.length - 1, Math.max(0, Math.round((now - times[0]) / page.time.step)));
  const said = [];
  for (const flight of flights) {
    const visible = shown[flight.index] && flight.position[0][k] !== null;
    const {body, arms} = flight.robot;
    body.visible = visible;
    flight.line.visible = shown[flight.index];
    if (visible) {
      body.position.set(...flight.position.map(axis => axis[k]));
      body.quaternion.set(...flight.quaternion.map(part => part[k])).normalize();
      arms.forEach(({turning, arrow}, arm) => {
        turning.rotation.x = flight.tilt[arm][k] || 0;
        const length = 0.03 * (flight.thrust[arm][k] || 0);
        arrow.visible = length > 0.01;
        arrow.userData.shaft.scale.y = Math.max(length, 1e-3);
        arrow.userData.shaft.position.z = length / 2 + 0.02;
        arrow.userData.head.position.z = length + 0.04;
      });
    }
    if (!flight.ghost) continue;
    const row = latest(flight.targets.t, now);
    flight.ghost.body.visible = visible && row >= 0;
    if (row < 0) continue;
    const pose = flight.targets.pose.slice(7 * row, 7 * row + 7);
    flight.ghost.body.position.set(...pose.slice(0, 3));
    flight.ghost.body.quaternion.set(...pose.slice(3)).normalize();
    if (visible) {
      const away = body.position.distanceTo(flight.ghost.body.position);
      const angle = body.quaternion.angleTo(flight.ghost.body.quaternion) * 180 / Math.PI;
      said.push([page.runs[flight.index], away, angle]);
    }
  }
  told.replaceChildren(...said.map(([run, away, angle]) => {
    const line = document.createElement('span');
    line.style.color = run.colour;
    line.textContent = `${run.label}: ${(1e3 * away).toFixed(0)} mm, ${angle.toFixed(1)}°`;
    return line;
  }));
  due = true;
}

function view(direction) {
  const middle = points.set(...spread.low.map((low, k) => (low + spread.high[k]) / 2));
  const size = Math.max(...spread.low.map((low, k) => spread.high[k] - low)) + 0.9;
  controls.target.copy(middle);
  camera.position.copy(middle).addScaledVector(vector(direction).normalize(),
    size * (camera.aspect < 1 ? 1.6 / camera.aspect : 1.6));
  controls.update();
  due = true;
}

function resize() {
  const width = holder.clientWidth, height = Math.round(width < 600 ? width * 0.85 : width * 0.5);
  renderer.setSize(width, height);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  due = true;
}

controls.addEventListener('change', () => { due = true; });
clock.listeners.push(place);
runListeners.push(() => place(clock.now));
new ResizeObserver(resize).observe(holder);
resize();
const directions = {angle: [-0.7, -1.2, 0.7], top: [0, -0.01, 1], side: [0, -1, 0.05], front: [1, 0, 0.05]};
for (const button of document.querySelectorAll('[data-view]'))
  button.addEventListener('click', () => view(directions[button.dataset.view]));
view(directions.angle);
(function loop() {
  requestAnimationFrame(loop);
  if (!due) return;
  due = false;
  renderer.render(scene, camera);
})();
})();
clock.set(0);
