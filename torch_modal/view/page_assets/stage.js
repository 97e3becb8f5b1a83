// Drawing: a mesh with wires, trails and marks for each sequence, in cells over one canvas.

const FIELD_OF_VIEW = 26; // degrees, upright
const TO_SCENE = 1 / GRID_STEPS; // the longest side of the box around the shapes of a group is 1 in the scene

// The lights of the package's pictures: directions as the viewer sees them, and brightness. Materials are linear RGBA;
// as in the pictures, the lights multiply their colours of the screen, sRGB.
const SURFACE_SHADER = {
  vertexShader: `
    varying vec3 vNormal, vView;
    #ifdef PAINTED
      attribute vec4 paint;
      varying vec4 vPaint;
      varying vec2 vUv;
    #endif
    void main() {
      #ifdef PAINTED
        vPaint = paint;
        vUv = uv;
      #endif
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      vNormal = normalMatrix * normal;
      vView = -seen.xyz;
      gl_Position = projectionMatrix * seen;
    }`,
  fragmentShader: `
    uniform vec3 tint;
    uniform float opacity;
    varying vec3 vNormal, vView;
    #ifdef PAINTED
      uniform vec4 color;
      uniform sampler2D picture;
      varying vec4 vPaint;
      varying vec2 vUv;
    #endif
    float lit(vec3 n, vec3 place, float brightness) { return brightness * max(dot(n, normalize(place)), 0.0); }
    void main() {
      vec3 view = normalize(vView);
      vec3 n = normalize(vNormal);
      if (!gl_FrontFacing) n = -n; // open meshes show their inside too
      float light = lit(n, vec3(-2.0, 3.0, 4.0), 0.82) + lit(n, vec3(4.0, 1.0, 3.0), 0.30)
                  + lit(n, vec3(0.0, -3.0, 2.0), 0.14);
      float rim = 0.8 + 0.2 * sqrt(max(dot(n, view), 0.0)); // darker outlines separate what overlaps
      float shine = 0.07 * pow(max(dot(n, normalize(normalize(vec3(-2.0, 3.0, 4.0)) + view)), 0.0), 24.0);
      vec4 base = vec4(tint, opacity);
      #ifdef PAINTED
        base = color * vPaint;
        #ifdef TEXTURED
          base *= texture2D(picture, vUv);
        #endif
        base.rgb = mix(12.92 * base.rgb, 1.055 * pow(base.rgb, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, base.rgb));
        #ifdef CUT_OUT
          if (base.a < 0.5) discard;
        #endif
        #ifndef TRANSLUCENT
          base.a = 1.0;
        #endif
      #endif
      gl_FragColor = vec4(base.rgb * (0.25 + 0.77 * light) * rim + shine, base.a);
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

const PIXEL_RATIO = Math.min(window.devicePixelRatio || 1, 2);

function dotMaterial(size, tint, opacity, depthTest) {
  const uniforms = { size: { value: size * PIXEL_RATIO }, tint: { value: tint }, opacity: { value: opacity } };
  return new THREE.ShaderMaterial({ ...DOT_SHADER, uniforms, depthTest, depthWrite: false, transparent: true });
}

const lineMaterial = (color, opacity, depthTest = true) =>
  new THREE.LineBasicMaterial({ color, opacity, depthTest, depthWrite: false, transparent: true });

/** A texture that repeats. Filters work on linear colours. */
function textureOf(picture) {
  const texture = new THREE.Texture(picture);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.flipY = false; // coordinates begin at the upper left
  texture.anisotropy = 8;
  texture.needsUpdate = true;
  return texture;
}

/** The material of a part of a surface. */
function paintedMaterial(look, { color, alpha }, texture) {
  const blend = alpha === "BLEND";
  const used = { PAINTED: true, TEXTURED: texture, CUT_OUT: alpha === "MASK", TRANSLUCENT: blend };
  const defines = Object.fromEntries(Object.keys(used).filter((name) => used[name]).map((name) => [name, 1]));
  const uniforms = { ...look.uniforms, color: { value: color }, picture: { value: texture } };
  // Translucent back sides are drawn before the front sides.
  const passes = { transparent: blend, depthWrite: !blend, forceSinglePass: !blend };
  return new THREE.ShaderMaterial({ ...look, ...passes, defines, uniforms });
}

/** One sequence. A group holds what its sequences share: faces, edges, surface, and the orbit of the camera. */
class Actor {
  constructor(group, name, frames) {
    Object.assign(this, { group, name, frames });
    const attribute = (array, width) => new THREE.BufferAttribute(array, width);
    const vectors = (n) => attribute(new Float32Array(3 * n), 3);
    const { surface, view: { centre } } = group;
    this.position = vectors(group.n_vertices);
    this.normals = new Float32Array(3 * surface.vertices.length);
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(attribute(surface.triangles, 1));
    geometry.setAttribute("position", vectors(surface.vertices.length));
    geometry.setAttribute("normal", vectors(surface.vertices.length));
    if (surface.parts.length) {
      geometry.setAttribute("uv", attribute(surface.texcoords, 2));
      geometry.setAttribute("paint", attribute(surface.colors, 4));
    }
    // Holds all shapes: rays are tried against it first, and it need not be computed for each.
    geometry.boundingSphere = new THREE.Sphere(new THREE.Vector3(...centre), 2 / TO_SCENE);
    const wires = new THREE.BufferGeometry();
    wires.setAttribute("position", this.position);
    wires.setIndex(attribute(group.edges, 1));
    this.uniforms = { tint: { value: [1, 1, 1] }, opacity: { value: 1 } };
    const behindWires = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
    const look = { ...SURFACE_SHADER, ...behindWires, uniforms: this.uniforms, side: THREE.DoubleSide };
    this.plain = new THREE.ShaderMaterial(look);
    this.materials = surface.parts.map((part) => paintedMaterial(look, part, group.textures[part.texture]));
    let start = 0;
    surface.parts.forEach(({ n_corners }, i) => {
      geometry.addGroup(start, n_corners, i);
      start += n_corners;
    });
    this.mesh = new THREE.Mesh(geometry, this.plain);
    // A translucent shape first fills the depth alone, so that only its nearest side shows.
    this.depth = new THREE.Mesh(geometry, new THREE.ShaderMaterial({ ...look, colorWrite: false }));
    this.wires = new THREE.LineSegments(wires, lineMaterial(0x22303c, 0.32));
    this.wires.renderOrder = 100;
    for (const drawn of [this.mesh, this.depth, this.wires]) drawn.frustumCulled = false;
    this.trails = new THREE.Group();
    this.marks = new THREE.Group();
    this.root = new THREE.Group();
    this.root.scale.setScalar(TO_SCENE);
    this.root.position.set(...centre).multiplyScalar(-TO_SCENE);
    this.root.add(this.depth, this.mesh, this.wires, this.trails, this.marks);
  }

  /** Show the shape at a frame, which may lie between two. */
  setFrame(frame) {
    const low = Math.floor(frame);
    const part = frame - low;
    const first = this.frames[low % this.frames.length];
    const second = this.frames[(low + 1) % this.frames.length];
    const points = this.position.array;
    for (let i = 0; i < points.length; i++) points[i] = first[i] + part * (second[i] - first[i]);
    const { vertices, normals, triangles } = this.group.surface;
    const { position, normal } = this.mesh.geometry.attributes;
    gather(points, vertices, position.array);
    normalsOf(position.array, triangles, normals, this.normals);
    gather(this.normals, normals, normal.array);
    this.position.needsUpdate = position.needsUpdate = normal.needsUpdate = true;
  }

  /** With its materials, or plain: opaque, or translucent in the given place of the order. */
  setLook(painted, opacity, order) {
    const clear = opacity < 1;
    this.mesh.material = painted ? this.materials : this.plain;
    this.uniforms.opacity.value = opacity;
    this.depth.visible = clear;
    // Both are sorted among the translucent ones, by the order alone.
    this.plain.transparent = this.depth.material.transparent = clear;
    this.depth.renderOrder = 2 * order;
    this.mesh.renderOrder = 2 * order + 1;
  }

  /** Dots on vertices of the present shape. */
  setMarks(vertices) {
    const points = vertices.flatMap((vertex) => [...this.position.array.subarray(3 * vertex, 3 * vertex + 3)]);
    this.#clear(this.marks);
    this.#add(this.marks, THREE.Points, points, (...look) => dotMaterial(12, [0.09, 0.13, 0.18], ...look));
  }

  /** The ways of vertices through all frames, with a dot at each key-frame. */
  setTrails(vertices, keyframes, closed, color) {
    this.#clear(this.trails);
    const frames = closed ? [...this.frames, this.frames[0]] : this.frames;
    for (const vertex of vertices) {
      const pointsOf = (shapes) => shapes.flatMap((shape) => [...shape.subarray(3 * vertex, 3 * vertex + 3)]);
      this.#add(this.trails, THREE.Line, pointsOf(frames), (...look) => lineMaterial(color, ...look));
      const given = pointsOf(keyframes.map((frame) => frames[frame]));
      this.#add(this.trails, THREE.Points, given, (...look) => dotMaterial(8, [0.78, 0.42, 0.16], ...look));
    }
  }

  /** Bright where it is seen, faint where the surface hides it. */
  #add(to, Kind, points, material) {
    if (!points.length) return;
    for (const [opacity, depthTest] of [[0.3, false], [1, true]]) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(points), 3));
      const drawn = new Kind(geometry, material(opacity, depthTest));
      drawn.frustumCulled = false;
      drawn.renderOrder = 100;
      to.add(drawn);
    }
  }

  #clear(from) {
    for (const drawn of [...from.children]) {
      drawn.geometry.dispose();
      drawn.material.dispose();
      from.remove(drawn);
    }
  }
}

/** The camera of a group, which the controls of all its cells turn. */
class Orbit {
  constructor({ front, half, world_up }) {
    this.front = front;
    this.half = half.map((length) => Math.max(length * TO_SCENE, 1e-3));
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
    this.camera.up.set(...world_up);
    this.target = new THREE.Vector3();
    this.distance = 1;
  }

  connect(element, onChange) {
    const controls = new THREE.OrbitControls(this.camera, element);
    controls.target = this.target;
    controls.addEventListener("change", onChange);
  }

  /** Suit cells of another size; the zoom stays. */
  fit(width, height) {
    const away = this.camera.position.clone().sub(this.target);
    const zoom = away.length() / this.distance;
    const slope = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    const aspect = width / Math.max(height, 1);
    this.distance = 1.12 * Math.max(this.half[1] / slope, this.half[0] / (slope * aspect)) + this.half[2];
    this.camera.aspect = aspect;
    this.camera.position.copy(this.target).add(away.setLength(zoom * this.distance));
  }

  reset() {
    this.target.set(0, 0, 0);
    this.camera.position.set(...this.front).setLength(this.distance);
    this.camera.lookAt(this.target);
  }

  /** Put the clipping planes around all that can be seen. */
  clip() {
    this.camera.far = this.camera.position.length() + 2;
    this.camera.near = this.camera.far / 500;
    this.camera.updateProjectionMatrix();
  }
}

/** A part of the canvas, with the element over it that takes the pointer and holds names and marks. */
class Cell {
  constructor(orbit) {
    this.orbit = orbit;
    this.actors = []; // shown in it
    this.names = make("div", { class: "names" });
    this.marks = make("div", { "aria-hidden": "true" });
    this.element = make("section", { class: "cell" }, this.names, this.marks);
  }

  get box() {
    const { offsetLeft: x, offsetTop: y, offsetWidth: width, offsetHeight: height } = this.element;
    return { x, y, width, height };
  }

  /** The actor's vertex nearest to where a ray through a place of the cell hits, and that actor, or null. */
  vertexAt(x, y) {
    const { width, height } = this.box;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2((2 * x) / width - 1, 1 - (2 * y) / height), this.orbit.camera);
    const [hit] = ray.intersectObjects(this.actors.map(({ mesh }) => mesh), false);
    if (!hit) return null;
    const actor = this.actors.find(({ mesh }) => mesh === hit.object);
    const place = hit.object.worldToLocal(hit.point.clone());
    const away = (v) => place.distanceToSquared(new THREE.Vector3().fromBufferAttribute(actor.position, v));
    const corners = [hit.face.a, hit.face.b, hit.face.c].map((point) => actor.group.surface.vertices[point]);
    const [vertex] = corners.sort((a, b) => away(a) - away(b));
    return { actor, vertex };
  }

  /** Where a vertex of an actor is seen, in pixels of the cell. */
  placeOf(actor, vertex) {
    const { width, height } = this.box;
    const point = new THREE.Vector3().fromBufferAttribute(actor.position, vertex);
    this.orbit.camera.updateMatrixWorld();
    actor.root.updateMatrixWorld();
    point.applyMatrix4(actor.root.matrixWorld).project(this.orbit.camera);
    return { x: ((point.x + 1) / 2) * width, y: ((1 - point.y) / 2) * height };
  }
}

/** The canvas, and a cell for each actor in a grid over it. */
class Stage {
  constructor(canvas, grid, actors, onChange) {
    Object.assign(this, { canvas, grid, actors });
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    // The shaders give the colours of the screen, as the pictures' renderers do; nothing is converted.
    THREE.ColorManagement.enabled = false;
    this.renderer.outputColorSpace = "srgb-linear";
    this.renderer.setPixelRatio(PIXEL_RATIO);
    this.renderer.setScissorTest(true);
    this.scene = new THREE.Scene();
    this.scene.add(...actors.map(({ root }) => root));
    this.orbits = [...new Set(actors.map(({ group }) => group.orbit))];
    this.cells = actors.map(({ group }) => new Cell(group.orbit));
    for (const { element, orbit } of this.cells) {
      grid.append(element);
      orbit.connect(element, onChange);
    }
  }

  /** Divide the canvas among the shown actors, or show them all in one cell. */
  layOut(shown, overlaid) {
    this.cells.forEach((cell, i) => {
      cell.actors = shown.includes(this.actors[i]) ? [this.actors[i]] : [];
      if (overlaid) cell.actors = this.actors[i] === shown[0] ? shown : [];
      cell.element.hidden = !cell.actors.length;
    });
    const cells = this.cells.filter(({ actors }) => actors.length);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    // As many columns as let the shapes be largest.
    let best = { scale: 0, columns: 1 };
    for (let columns = 1; columns <= cells.length; columns++) {
      const rows = Math.ceil(cells.length / columns);
      const scales = cells.map(({ orbit: { half } }) => Math.min(width / columns / half[0], height / rows / half[1]));
      if (Math.min(...scales) > 1.02 * best.scale) best = { scale: Math.min(...scales), columns };
    }
    this.grid.style.setProperty("--columns", best.columns);
    this.renderer.setSize(width, height, false);
    for (const { orbit, box } of cells) orbit.fit(box.width, box.height);
  }

  draw() {
    const { clientWidth, clientHeight } = this.canvas;
    this.renderer.setScissor(0, 0, clientWidth, clientHeight);
    this.renderer.setViewport(0, 0, clientWidth, clientHeight);
    this.renderer.setClearColor(0xffffff, 0);
    this.renderer.clear();
    for (const orbit of this.orbits) orbit.clip();
    for (const cell of this.cells) {
      if (!cell.actors.length) continue;
      for (const actor of this.actors) actor.root.visible = cell.actors.includes(actor);
      const { x, y, width, height } = cell.box;
      const port = [x, clientHeight - y - height, width, height];
      this.renderer.setViewport(...port);
      this.renderer.setScissor(...port);
      this.renderer.render(this.scene, cell.orbit.camera);
    }
  }
}
