// What is drawn: a mesh with wires, trails and marks for each sequence, in one viewport each or all in one.

const FIELD_OF_VIEW = 26; // degrees, upright
const TO_SCENE = 1 / 65535; // the longest side of the box around everything is 1 in the scene

// The lights of the package's pictures: from where, as the viewer sees it, and how bright.
const SURFACE_SHADER = {
  vertexShader: `
    attribute vec3 paint;
    varying vec3 vNormal, vView, vPaint;
    void main() {
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      vNormal = normalMatrix * normal;
      vView = -seen.xyz;
      vPaint = paint;
      gl_Position = projectionMatrix * seen;
    }`,
  fragmentShader: `
    uniform vec3 tint;
    uniform float painted, opacity;
    varying vec3 vNormal, vView, vPaint;
    float lit(vec3 n, vec3 place, float brightness) { return brightness * max(dot(n, normalize(place)), 0.0); }
    void main() {
      vec3 view = normalize(vView);
      vec3 n = normalize(vNormal);
      if (!gl_FrontFacing) n = -n; // open meshes show their inside too
      float light = lit(n, vec3(-2.0, 3.0, 4.0), 0.82) + lit(n, vec3(4.0, 1.0, 3.0), 0.30)
                  + lit(n, vec3(0.0, -3.0, 2.0), 0.14);
      float rim = 0.8 + 0.2 * sqrt(max(dot(n, view), 0.0)); // darker outlines part what overlaps
      float shine = 0.07 * pow(max(dot(n, normalize(normalize(vec3(-2.0, 3.0, 4.0)) + view)), 0.0), 24.0);
      vec3 base = mix(tint, vPaint, painted);
      gl_FragColor = vec4(base * (0.25 + 0.77 * light) * rim + shine, opacity);
    }`,
};

// Round dots of a fixed size, drawn a little towards the viewer so that the surface does not cut them.
const DOT_SHADER = {
  vertexShader: `
    uniform float size;
    void main() {
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      gl_Position.z -= 0.0015 * gl_Position.w;
      gl_PointSize = size;
    }`,
  fragmentShader: `
    uniform vec3 tint;
    uniform float opacity;
    void main() {
      float r = 2.0 * length(gl_PointCoord - 0.5);
      if (r > 1.0) discard;
      gl_FragColor = vec4(r > 0.68 ? vec3(1.0) : tint, opacity);
    }`,
};

function dotMaterial(size, tint, opacity, depthTest) {
  const uniforms = { size: { value: size }, tint: { value: tint }, opacity: { value: opacity } };
  return new THREE.ShaderMaterial({ ...DOT_SHADER, uniforms, depthTest, depthWrite: false, transparent: true });
}

const lineMaterial = (color, opacity, depthTest = true) =>
  new THREE.LineBasicMaterial({ color, opacity, depthTest, depthWrite: false, transparent: true });

/** One sequence: what is shown of it at the present time. */
class Actor {
  constructor(nVertices, faces, edges, centre, ratio) {
    const indices = (array) => new THREE.BufferAttribute(array, 1);
    const vectors = () => new THREE.BufferAttribute(new Float32Array(3 * nVertices), 3);
    this.ratio = ratio;
    this.group = new THREE.Group();
    this.group.scale.setScalar(TO_SCENE);
    this.group.position.set(...centre).multiplyScalar(-TO_SCENE);
    this.geometry = new THREE.BufferGeometry();
    this.geometry.setIndex(indices(faces));
    this.position = vectors();
    this.normal = vectors();
    this.paint = vectors();
    for (const name of ["position", "normal", "paint"]) this.geometry.setAttribute(name, this[name]);
    // Holds all shapes: rays are tried against it first, and it is not to be computed anew for each.
    this.geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(...centre), 2 / TO_SCENE);
    this.uniforms = { tint: { value: [1, 1, 1] }, painted: { value: 0 }, opacity: { value: 1 } };
    const behindWires = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
    const surface = { ...SURFACE_SHADER, ...behindWires, uniforms: this.uniforms, side: THREE.DoubleSide };
    this.mesh = new THREE.Mesh(this.geometry, new THREE.ShaderMaterial(surface));
    // A translucent shape first fills the depth alone, so that only its nearest side is seen through.
    this.depth = new THREE.Mesh(this.geometry, new THREE.ShaderMaterial({ ...surface, colorWrite: false }));
    const wires = new THREE.BufferGeometry();
    wires.setAttribute("position", this.position);
    wires.setIndex(indices(edges));
    wires.boundingSphere = this.geometry.boundingSphere;
    this.wires = new THREE.LineSegments(wires, lineMaterial(0x22303c, 0.32));
    this.trails = new THREE.Group();
    this.marks = new THREE.Group();
    this.group.add(this.depth, this.mesh, this.wires, this.trails, this.marks);
    for (const drawn of [this.mesh, this.depth, this.wires]) drawn.frustumCulled = false;
  }

  /** The shape has been written into `position.array`. */
  changed(faces) {
    normalsOf(this.position.array, faces, this.normal.array);
    this.position.needsUpdate = this.normal.needsUpdate = true;
  }

  /** Opaque, or seen through in the given place of the order. */
  setLook(opacity, order) {
    const clear = opacity < 1;
    this.uniforms.opacity.value = opacity;
    this.mesh.material.transparent = clear;
    this.depth.visible = clear;
    this.depth.material.transparent = clear; // sorted among the translucent ones, by the order alone
    this.depth.renderOrder = 2 * order;
    this.mesh.renderOrder = 2 * order + 1;
    this.wires.renderOrder = this.trails.renderOrder = this.marks.renderOrder = 100;
  }

  /** Dots on vertices of the present shape: bright where they are seen, faint where they are hidden. */
  setMarks(vertices) {
    this.#refill(this.marks);
    if (!vertices.length) return;
    const points = new Float32Array(3 * vertices.length);
    vertices.forEach((vertex, i) => points.set(this.position.array.subarray(3 * vertex, 3 * vertex + 3), 3 * i));
    const tint = [0.09, 0.13, 0.18];
    for (const [opacity, test] of [[0.3, false], [1, true]]) {
      this.#add(this.marks, THREE.Points, points, dotMaterial(12 * this.ratio, tint, opacity, test));
    }
  }

  /** The ways of vertices through all frames, with a dot at each key-frame. */
  setTrails(frames, vertices, keyframes, closed, color) {
    this.#refill(this.trails);
    for (const vertex of vertices) {
      const points = new Float32Array(3 * (frames.length + closed));
      for (let f = 0; f < frames.length + closed; f++) {
        points.set(frames[f % frames.length].subarray(3 * vertex, 3 * vertex + 3), 3 * f);
      }
      const dots = Float32Array.from(keyframes.flatMap((f) => [...points.subarray(3 * f, 3 * f + 3)]));
      for (const [opacity, test] of [[0.35, false], [1, true]]) {
        this.#add(this.trails, THREE.Line, points, lineMaterial(color, opacity, test));
        this.#add(this.trails, THREE.Points, dots, dotMaterial(8 * this.ratio, [0.78, 0.42, 0.16], opacity, test));
      }
    }
  }

  #add(group, Kind, points, material) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
    const drawn = new Kind(geometry, material);
    drawn.frustumCulled = false;
    drawn.renderOrder = 100;
    group.add(drawn);
  }

  #refill(group) {
    for (const drawn of [...group.children]) {
      drawn.geometry.dispose();
      drawn.material.dispose();
      group.remove(drawn);
    }
  }
}

/** The canvas, its camera and its viewports. */
class Stage {
  /**
   * @param view `right`, `up`, `front` and `world_up` are directions, `centre` is in steps of the grid, and `half` the
   *   half sizes along right, up and front in steps of the grid, of all shapes together.
   */
  constructor(canvas, view, onChange) {
    this.canvas = canvas;
    this.view = view;
    this.half = view.half.map((length) => Math.max(length * TO_SCENE, 1e-3));
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    // The shaders give the colours of the screen, as the pictures' renderers do; nothing is converted.
    THREE.ColorManagement.enabled = false;
    this.renderer.outputColorSpace = "srgb-linear";
    this.ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setScissorTest(true);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
    this.actors = [];
    this.viewports = []; // {x, y, width, height, shown: [numbers of actors]}, in CSS pixels, y down
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", onChange);
    this.distance = 1;
    this.aspect = 1;
  }

  add(nVertices, faces, edges) {
    const actor = new Actor(nVertices, faces, edges, this.view.centre, this.ratio);
    this.actors.push(actor);
    this.scene.add(actor.group);
    return actor;
  }

  /** Divide the canvas among the shown actors; what was zoomed stays so. */
  layOut(shown, overlaid) {
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    const cells = overlaid ? [shown] : shown.map((number) => [number]);
    // As many columns as let the shapes be largest.
    const fits = [];
    for (let columns = 1; columns <= Math.max(cells.length, 1); columns++) {
      const rows = Math.ceil(Math.max(cells.length, 1) / columns);
      const scale = Math.min(width / columns / this.half[0], height / rows / this.half[1]);
      fits.push({ scale, columns, rows });
    }
    const best = fits.reduce((a, b) => (b.scale > 1.02 * a.scale ? b : a));
    const cell = { width: width / best.columns, height: height / best.rows };
    this.viewports = cells.map((actors, i) => ({
      x: (i % best.columns) * cell.width,
      y: Math.floor(i / best.columns) * cell.height,
      ...cell,
      shown: actors,
    }));
    this.renderer.setSize(width, height, false);
    const zoom = this.camera.position.distanceTo(this.controls.target) / this.distance;
    this.aspect = cell.width / Math.max(cell.height, 1);
    this.distance = this.#fittingDistance();
    this.camera.aspect = this.aspect;
    this.camera.updateProjectionMatrix();
    const away = this.camera.position.clone().sub(this.controls.target);
    this.camera.position.copy(this.controls.target).add(away.setLength(zoom * this.distance));
    this.controls.update();
  }

  /** From where all shapes just fill a viewport. */
  #fittingDistance() {
    const slope = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    return 1.12 * Math.max(this.half[1] / slope, this.half[0] / (slope * this.aspect)) + this.half[2];
  }

  resetView() {
    this.controls.target.set(0, 0, 0);
    this.camera.up.set(...this.view.world_up);
    this.camera.position.set(...this.view.front).setLength(this.distance);
    this.controls.update();
  }

  draw() {
    const far = this.camera.position.length() + 2;
    this.camera.near = far / 500;
    this.camera.far = far;
    this.camera.updateProjectionMatrix();
    const height = this.canvas.clientHeight;
    this.renderer.setScissor(0, 0, this.canvas.clientWidth, height);
    this.renderer.setViewport(0, 0, this.canvas.clientWidth, height);
    this.renderer.setClearColor(0xffffff, 0);
    this.renderer.clear();
    for (const port of this.viewports) {
      this.actors.forEach((actor, number) => (actor.group.visible = port.shown.includes(number)));
      const box = [port.x, height - port.y - port.height, port.width, port.height];
      this.renderer.setViewport(...box);
      this.renderer.setScissor(...box);
      this.renderer.render(this.scene, this.camera);
    }
  }

  /** The vertex nearest to where a ray through a place of the canvas hits, or null. */
  vertexAt(x, y) {
    const port = this.viewports.find((p) => x >= p.x && x < p.x + p.width && y >= p.y && y < p.y + p.height);
    if (!port) return null;
    const place = new THREE.Vector2((2 * (x - port.x)) / port.width - 1, 1 - (2 * (y - port.y)) / port.height);
    const ray = new THREE.Raycaster();
    this.scene.updateMatrixWorld();
    ray.setFromCamera(place, this.camera);
    const meshes = port.shown.map((number) => this.actors[number].mesh);
    const [hit] = ray.intersectObjects(meshes, false);
    if (!hit) return null;
    const positions = hit.object.geometry.getAttribute("position");
    const local = hit.object.worldToLocal(hit.point.clone());
    const corners = [hit.face.a, hit.face.b, hit.face.c];
    const away = corners.map((v) => local.distanceToSquared(new THREE.Vector3().fromBufferAttribute(positions, v)));
    return corners[away.indexOf(Math.min(...away))];
  }

  /** Where a vertex of an actor is seen in a viewport, in CSS pixels of the canvas. */
  placeOf(vertex, number, port) {
    const actor = this.actors[number];
    const point = new THREE.Vector3().fromBufferAttribute(actor.position, vertex);
    this.scene.updateMatrixWorld();
    this.camera.updateMatrixWorld();
    point.applyMatrix4(actor.group.matrixWorld).project(this.camera);
    return { x: port.x + ((point.x + 1) / 2) * port.width, y: port.y + ((1 - point.y) / 2) * port.height };
  }
}
