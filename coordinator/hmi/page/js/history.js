import { h } from "./dom.js";
export class History { constructor() { this.root = h("div", {}); } follow() {} restart() {} }
