// node web.mjs three|babylon [--res 768] VIEWS.json OUTDIR NAME=FILE.glb ...
// Headless Chromium, with software WebGL, draws each file from each view: OUTDIR/NAME_k.png. Run it
// from a folder with the modules that package.json names; CHROMIUM: the browser's path.
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const require = createRequire(join(process.cwd(), "any.js"));
const { build } = require("esbuild");
const puppeteer = require("puppeteer-core");
const args = process.argv.slice(2);
const at = args.indexOf("--res");
const res = at < 0 ? 768 : +args.splice(at, 2)[1];
const [engine, viewsFile, out, ...files] = args;
const named = files.map((f) => [f.slice(0, f.indexOf("=")), f.slice(f.indexOf("=") + 1)]);

const bundle = await build({
  entryPoints: [join(here, `web_${engine}.js`)], bundle: true, write: false, format: "iife",
  logLevel: "error", nodePaths: [resolve("node_modules")], loader: { ".wasm": "binary" },
});
const server = createServer((request, answer) => {
  const file = request.url.match(/^\/(\d+)\.glb/);
  if (request.url === "/page") {
    answer.setHeader("content-type", "text/html");
    answer.end("<!doctype html><script src=/bundle.js></script>");
  } else if (request.url === "/bundle.js") {
    answer.setHeader("content-type", "text/javascript");
    answer.end(bundle.outputFiles[0].contents);
  } else if (file) answer.end(readFileSync(named[+file[1]][1]));
  else (answer.statusCode = 404), answer.end();
}).listen(0, "127.0.0.1");
await new Promise((done) => server.on("listening", done));
const base = `http://127.0.0.1:${server.address().port}`;
const { views, radius, centre } = JSON.parse(readFileSync(viewsFile));
for (const v of views) {
  const distance = Math.hypot(...v.eye.map((x, i) => x - centre[i]));
  v.near = Math.max(distance - 1.6 * radius, 0.01 * distance);
  v.far = distance + 1.6 * radius;
}
const browser = await puppeteer.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", headless: true,
  protocolTimeout: 600000,
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
});
mkdirSync(out, { recursive: true });
for (const [k, [name]] of named.entries()) {
  const page = await browser.newPage();
  page.on("pageerror", (e) => console.error(name, String(e)));
  await page.goto(`${base}/page`);
  await page.waitForFunction("window.ready");
  const draw = (url, list, size) => window.draw(url, list, size);
  const images = await page.evaluate(draw, `${base}/${k}.glb`, views, res);
  images.forEach((image, i) =>
    writeFileSync(join(out, `${name}_${i}.png`), Buffer.from(image.split(",")[1], "base64")));
  await page.close();
}
await browser.close();
server.close();
