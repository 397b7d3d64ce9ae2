'use strict';
// The two views: the surface in space and the layout in the plane, of the map whose tab is chosen.

const data = JSON.parse(document.getElementById('data').textContent);
const numbers = (type, text) => new type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
const positions = numbers(Float32Array, data.positions);
const faces = numbers(Uint32Array, data.faces);
const seams = numbers(Uint32Array, data.seams);
const maps = data.maps.map((map) => ({
  uv: numbers(Float32Array, map.uv), colour: numbers(Uint8Array, map.colour),
}));

// One corner after the other, so that a triangle has one colour and UVs of its own.
function corners(values, width, indices) {
  const out = new Float32Array(indices.length * width);
  for (let i = 0; i < indices.length; i++)
    for (let k = 0; k < width; k++) out[i * width + k] = values[indices[i] * width + k];
  return out;
}

function inSpace(uv) {
  const out = new Float32Array((uv.length / 2) * 3);
  for (let i = 0; i < uv.length / 2; i++) { out[3 * i] = uv[2 * i]; out[3 * i + 1] = uv[2 * i + 1]; }
  return out;
}

function perCorner(colour) {
  const out = new Uint8Array(3 * colour.length);
  for (let i = 0; i < out.length; i++) out[i] = colour[(i / 3) | 0];
  return out;
}

const vertexShader = `
attribute vec2 texture_; attribute float level;
varying vec2 at; varying float shown; varying vec3 eye;
void main() {
  at = texture_; shown = level * 255.0;
  vec4 p = modelViewMatrix * vec4(position, 1.0);
  eye = p.xyz; gl_Position = projectionMatrix * p;
}`;

// Level 255 is a flipped triangle. The checkerboard is averaged over a pixel, so it does not flicker.
const fragmentShader = `
uniform vec3 ramp[10]; uniform float squares; uniform bool checker; uniform bool lit;
varying vec2 at; varying float shown; varying vec3 eye;
vec3 scale(float x) {
  float y = clamp(x, 0.0, 1.0) * 9.0; vec3 c = ramp[0];
  for (int i = 1; i < 10; i++) c = mix(c, ramp[i], clamp(y - float(i - 1), 0.0, 1.0));
  return c;
}
// Antiderivative of a wave that is -1 and 1 on alternate unit intervals, negated.
vec2 integral(vec2 x) { return abs(fract(x * 0.5) - 0.5) * 2.0; }
void main() {
  bool flipped = shown > 254.5;
  vec3 colour;
  if (checker) {
    vec2 x = at * squares, width = max(fwidth(x), vec2(1e-6));
    vec2 wave = (integral(x - 0.5 * width) - integral(x + 0.5 * width)) / width;
    float mixed = 0.5 + 0.5 * clamp(wave.x, -1.0, 1.0) * clamp(wave.y, -1.0, 1.0);
    colour = mix(vec3(0.16, 0.42, 0.67), vec3(0.98, 0.97, 0.94), mixed);
  } else colour = scale(shown / 254.0);
  if (flipped) colour = vec3(0.88, 0.15, 0.11);
  if (lit) {
    vec3 normal = normalize(cross(dFdx(eye), dFdy(eye)));
    float light = abs(dot(normal, normalize(vec3(0.25, 0.35, 0.9))));
    colour *= 0.42 + 0.6 * light;
    if (!gl_FrontFacing) colour = mix(colour, vec3(0.45, 0.3, 0.24), 0.55);
  }
  gl_FragColor = vec4(colour, 1.0);
}`;

function material(lit, checker) {
  const ramp = data.ramp.map((c) => new THREE.Vector3(...c));
  return new THREE.ShaderMaterial({
    vertexShader, fragmentShader, side: THREE.DoubleSide, extensions: { derivatives: true },
    polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1,
    uniforms: {
      ramp: { value: ramp }, squares: { value: 1 }, checker: { value: checker }, lit: { value: lit },
    },
  });
}

function lines(points, indices, colour, opacity) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.BufferAttribute(points, 3));
  geometry.setIndex(new THREE.BufferAttribute(indices, 1));
  return new THREE.LineSegments(
    geometry, new THREE.LineBasicMaterial({ color: colour, transparent: opacity < 1, opacity }));
}

function edgesOf(triangles) {
  const out = new Uint32Array(2 * triangles.length);
  for (let i = 0; i < triangles.length; i++) {
    out[2 * i] = triangles[i];
    out[2 * i + 1] = triangles[i % 3 === 2 ? i - 2 : i + 1];
  }
  return out;
}

class View {
  constructor(id, camera) {
    this.box = document.getElementById(id);
    this.camera = camera;
    this.scene = new THREE.Scene();
    this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.box.appendChild(this.renderer.domElement);
    this.waiting = false;
    new ResizeObserver(() => this.resize()).observe(this.box);
  }
  draw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.renderer.render(this.scene, this.camera); });
  }
  resize() {
    const { clientWidth: w, clientHeight: h } = this.box;
    if (!w || !h) return;
    this.renderer.setSize(w, h);
    this.fit(w, h);
    this.draw();
  }
}

const ink = matchMedia('(prefers-color-scheme: dark)').matches ? 0xf2f4f6 : 0x14171b;

class Surface extends View {
  constructor() {
    super('surface', new THREE.PerspectiveCamera(35, 1, 0.01, 100));
    this.geometry = new THREE.BufferGeometry();
    this.geometry.setAttribute('position', new THREE.BufferAttribute(corners(positions, 3, faces), 3));
    this.material = material(true, true);
    this.scene.add(new THREE.Mesh(this.geometry, this.material));
    this.seams = lines(positions, seams, 0x101215, 1);
    this.scene.add(this.seams);
    this.controls = new THREE.TrackballControls(this.camera, this.box);
    this.controls.rotateSpeed = 2.5; this.controls.zoomSpeed = 1.2; this.controls.panSpeed = 0.4;
    this.controls.staticMoving = true;
    this.controls.addEventListener('change', () => this.draw());
    const follow = () => { this.controls.update(); requestAnimationFrame(follow); };
    follow();
  }
  reset() {
    this.controls.target.set(0, 0, 0);
    this.camera.up.set(...data.up);
    this.camera.position.set(...data.eye).multiplyScalar(this.distance());
    this.controls.update(); this.draw();
  }
  // The least from which all vertices are in sight, and a little more.
  distance() {
    const eye = new THREE.Vector3(...data.eye), p = new THREE.Vector3();
    const right = new THREE.Vector3(...data.up).cross(eye).normalize();
    const above = eye.clone().cross(right);
    const slope = Math.tan(this.camera.fov * Math.PI / 360);
    let least = 0.1;
    for (let i = 0; i < positions.length; i += 3) {
      p.fromArray(positions, i);
      const across = Math.max(Math.abs(p.dot(above)), Math.abs(p.dot(right)) / this.camera.aspect);
      least = Math.max(least, p.dot(eye) + across / slope);
    }
    return 1.06 * least;
  }
  fit(w, h) {
    const first = !this.fitted;
    this.fitted = true;
    this.camera.aspect = w / h;
    this.camera.updateProjectionMatrix(); this.controls.handleResize();
    if (first) this.reset();
  }
  show(map) {
    this.geometry.setAttribute('texture_', new THREE.BufferAttribute(corners(map.uv, 2, faces), 2));
    this.geometry.setAttribute('level', new THREE.BufferAttribute(perCorner(map.colour), 1, true));
    this.draw();
  }
}

class Layout extends View {
  constructor() {
    super('layout', new THREE.OrthographicCamera(-1, 1, 1, -1, -1, 1));
    this.geometry = new THREE.BufferGeometry();
    this.scene.add(new THREE.Mesh(this.geometry, material(false, false)));
    this.view = { x: 0, y: 0, zoom: 1 };
    this.listen();
  }
  show(map) {
    const flat = inSpace(map.uv);
    this.geometry.setAttribute('position', new THREE.BufferAttribute(corners(flat, 3, faces), 3));
    this.geometry.setAttribute('texture_', new THREE.BufferAttribute(new Float32Array(2 * faces.length), 2));
    this.geometry.setAttribute('level', new THREE.BufferAttribute(perCorner(map.colour), 1, true));
    for (const old of [this.edges, this.seams]) if (old) { this.scene.remove(old); old.geometry.dispose(); }
    this.edges = lines(flat, edgesOf(faces), 0x000000, 0.35);
    this.seams = lines(flat, seams, ink, 1);
    this.edges.visible = document.getElementById('edges').checked;
    this.seams.visible = document.getElementById('seams').checked;
    this.scene.add(this.edges, this.seams);
    this.flat = flat;
    this.resize();
  }
  bounds() {
    let [l, r, b, t] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let i = 0; i < this.flat.length; i += 3) {
      l = Math.min(l, this.flat[i]); r = Math.max(r, this.flat[i]);
      b = Math.min(b, this.flat[i + 1]); t = Math.max(t, this.flat[i + 1]);
    }
    return { x: (l + r) / 2, y: (b + t) / 2, w: r - l, h: t - b };
  }
  fit(w, h) {
    if (!this.flat) return;
    const box = this.bounds();
    // Units of the layout per pixel.
    this.unit = 1.08 * Math.max(box.w / w, box.h / h) / this.view.zoom;
    const [x, y] = [box.x + this.view.x, box.y + this.view.y];
    const [dx, dy] = [0.5 * w * this.unit, 0.5 * h * this.unit];
    Object.assign(this.camera, { left: x - dx, right: x + dx, bottom: y - dy, top: y + dy });
    this.camera.updateProjectionMatrix();
  }
  reset() { this.view = { x: 0, y: 0, zoom: 1 }; this.resize(); }
  zoomAt(factor, clientX, clientY) {
    const box = this.box.getBoundingClientRect();
    const [px, py] = [clientX - box.left - box.width / 2, box.top + box.height / 2 - clientY];
    const before = this.unit;
    this.view.zoom = Math.min(Math.max(this.view.zoom * factor, 0.5), 500);
    this.fit(box.width, box.height);
    this.view.x += px * (before - this.unit); this.view.y += py * (before - this.unit);
    this.resize();
  }
  listen() {
    const fingers = new Map();
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return { d: Math.hypot(a.x - b.x, a.y - b.y), x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 };
    };
    this.box.addEventListener('pointerdown', (e) => {
      fingers.set(e.pointerId, { x: e.clientX, y: e.clientY }); this.box.setPointerCapture(e.pointerId);
    });
    this.box.addEventListener('pointermove', (e) => {
      const last = fingers.get(e.pointerId);
      if (!last) return;
      const before = fingers.size === 2 ? spread() : null;
      this.view.x -= (e.clientX - last.x) * this.unit / fingers.size;
      this.view.y += (e.clientY - last.y) * this.unit / fingers.size;
      fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
      if (before && before.d > 0) { const now = spread(); this.zoomAt(now.d / before.d, now.x, now.y); }
      else this.resize();
    });
    for (const end of ['pointerup', 'pointercancel'])
      this.box.addEventListener(end, (e) => fingers.delete(e.pointerId));
    this.box.addEventListener('wheel', (e) => {
      e.preventDefault(); this.zoomAt(Math.exp(-0.0015 * e.deltaY), e.clientX, e.clientY);
    }, { passive: false });
  }
}

function start() {
  const [surface, layout] = [new Surface(), new Layout()];
  const tabs = [...document.querySelectorAll('[role=tab]')];
  const squares = document.getElementById('squares');

  function choose(i) {
    tabs.forEach((tab, k) => {
      tab.setAttribute('aria-selected', String(k === i)); tab.tabIndex = k === i ? 0 : -1;
    });
    surface.show(maps[i]); layout.show(maps[i]);
    document.body.dataset.map = String(i);
  }
  tabs.forEach((tab, i) => {
    tab.addEventListener('click', () => choose(i));
    tab.addEventListener('keydown', (e) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
      if (!step) return;
      const next = (i + step + tabs.length) % tabs.length;
      choose(next); tabs[next].focus();
    });
  });
  const modes = [...document.querySelectorAll('#surface-colour button')];
  modes.forEach((button) => button.addEventListener('click', () => {
    modes.forEach((other) => other.setAttribute('aria-pressed', String(other === button)));
    surface.material.uniforms.checker.value = button.dataset.mode === 'checker';
    squares.disabled = button.dataset.mode !== 'checker';
    surface.draw();
  }));
  // UVs are in units of the root of the area: 2^k squares along it.
  const resize = () => { surface.material.uniforms.squares.value = 2 ** squares.value; surface.draw(); };
  squares.addEventListener('input', resize);
  document.getElementById('edges').addEventListener('change', (e) => {
    layout.edges.visible = e.target.checked; layout.draw();
  });
  document.getElementById('seams').addEventListener('change', (e) => {
    layout.seams.visible = surface.seams.visible = e.target.checked; layout.draw(); surface.draw();
  });
  document.getElementById('reset').addEventListener('click', () => { surface.reset(); layout.reset(); });
  resize(); choose(0);
}

const probe = document.createElement('canvas');
if (probe.getContext('webgl2') || probe.getContext('webgl')) start();
else for (const box of document.querySelectorAll('.canvas'))
  box.innerHTML = '<p class="missing">This browser has no WebGL, so there is no view; the figures below are complete.</p>';
