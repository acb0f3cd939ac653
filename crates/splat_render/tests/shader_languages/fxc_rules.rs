//! Patterns that DX12's older compiler (FXC) refuses or miscompiles, found in naga's IR. FXC itself runs
//! only on Windows.

use naga::proc::TypeResolution;
use naga::valid::{FunctionInfo, ModuleInfo};
use naga::{
    AddressSpace, Block, Expression, Function, Handle, Module, SampleLevel, Statement, TypeInner,
};

/// Every breach, as text.
pub fn breaches(module: &Module, info: &ModuleInfo) -> Vec<String> {
    let mut found = Vec::new();
    for (handle, function) in module.functions.iter() {
        let name = function.name.clone().unwrap_or_default();
        Walk { module, function, of: &info[handle], name, found: &mut found }.all(true);
    }
    for (index, entry) in module.entry_points.iter().enumerate() {
        let of = info.get_entry_point(index);
        let name = entry.name.clone();
        let function = &entry.function;
        Walk { module, function, of, name, found: &mut found }.all(false);
    }
    found
}

struct Walk<'a> {
    module: &'a Module,
    function: &'a Function,
    of: &'a FunctionInfo,
    name: String,
    found: &'a mut Vec<String>,
}

impl Walk<'_> {
    fn all(&mut self, is_called: bool) {
        self.block(&self.function.body, false, false, is_called);
    }

    fn report(&mut self, what: &str) {
        self.found.push(format!("{}: {what}", self.name));
    }

    /// `is_called`: whether the function is inlined into another.
    fn block(&mut self, block: &Block, in_loop: bool, in_switch: bool, is_called: bool) {
        for statement in block {
            match statement {
                Statement::Block(inner) => self.block(inner, in_loop, in_switch, is_called),
                Statement::If { accept, reject, .. } => {
                    self.block(accept, in_loop, in_switch, is_called);
                    self.block(reject, in_loop, in_switch, is_called);
                }
                Statement::Switch { cases, .. } => {
                    if in_loop {
                        self.report("a switch in a loop");
                    }
                    for case in cases {
                        self.block(&case.body, in_loop, true, is_called);
                    }
                }
                Statement::Loop { body, continuing, .. } => {
                    self.block(body, true, false, is_called);
                    self.block(continuing, true, false, is_called);
                }
                Statement::Continue if in_switch => self.report("continue in a switch"),
                // FXC inlines every call: the return becomes flags that all loops around it test.
                Statement::Return { .. } if in_loop && is_called => {
                    self.report("a return from within a loop of a called function");
                }
                Statement::Store { pointer, .. } => self.store(*pointer),
                Statement::Emit(range) if in_loop => {
                    for expression in range.clone() {
                        if takes_gradient(&self.function.expressions[expression]) {
                            self.report("a gradient in a loop");
                        }
                    }
                }
                Statement::Call { function, .. } if in_loop => {
                    for what in in_loops(self.module, *function) {
                        self.report(what);
                    }
                }
                _ => {}
            }
        }
    }

    /// FXC cannot assign to a component picked at run time, unless the loop around it is unrolled.
    /// Storage buffers are written by address.
    fn store(&mut self, pointer: Handle<Expression>) {
        let mut at = pointer;
        let mut picks = false;
        loop {
            at = match self.function.expressions[at] {
                Expression::Access { base, .. } => {
                    picks |= self.is_vector(base);
                    base
                }
                Expression::AccessIndex { base, .. } => base,
                Expression::GlobalVariable(variable) => {
                    let space = self.module.global_variables[variable].space;
                    picks &= !matches!(space, AddressSpace::Storage { .. });
                    break;
                }
                _ => break,
            };
        }
        if picks {
            self.report("a store to a component that is picked at run time");
        }
    }

    fn is_vector(&self, pointer: Handle<Expression>) -> bool {
        let inner = match &self.of[pointer].ty {
            TypeResolution::Handle(ty) => &self.module.types[*ty].inner,
            TypeResolution::Value(inner) => inner,
        };
        match inner {
            TypeInner::Pointer { base, .. } => matches!(
                self.module.types[*base].inner,
                TypeInner::Vector { .. } | TypeInner::Matrix { .. }
            ),
            TypeInner::ValuePointer { size, .. } => size.is_some(),
            _ => false,
        }
    }
}

fn takes_gradient(expression: &Expression) -> bool {
    match expression {
        Expression::Derivative { .. } => true,
        Expression::ImageSample { level, .. } => {
            matches!(level, SampleLevel::Auto | SampleLevel::Bias(_))
        }
        _ => false,
    }
}

/// Violations of a function, including its callees, if called in a loop.
fn in_loops(module: &Module, function: Handle<Function>) -> Vec<&'static str> {
    let function = &module.functions[function];
    let mut found = Vec::new();
    if function.expressions.iter().any(|(_, e)| takes_gradient(e)) {
        found.push("a gradient in a function that a loop calls");
    }
    visit(&function.body, &mut |statement| match statement {
        Statement::Switch { .. } => found.push("a switch in a function that a loop calls"),
        Statement::Call { function, .. } => found.extend(in_loops(module, *function)),
        _ => {}
    });
    found
}

fn visit(block: &Block, see: &mut impl FnMut(&Statement)) {
    for statement in block {
        see(statement);
        match statement {
            Statement::Block(inner) => visit(inner, see),
            Statement::If { accept, reject, .. } => {
                visit(accept, see);
                visit(reject, see);
            }
            Statement::Switch { cases, .. } => cases.iter().for_each(|c| visit(&c.body, see)),
            Statement::Loop { body, continuing, .. } => {
                visit(body, see);
                visit(continuing, see);
            }
            _ => {}
        }
    }
}

fn breaches_of(body: &str) -> Vec<String> {
    let text = format!(
        "@group(0) @binding(0) var<storage, read_write> out: array<vec4<f32>>;
         @group(0) @binding(1) var texture: texture_2d<f32>;
         @group(0) @binding(2) var linear: sampler;
         fn pick(k: u32) -> f32 {{ switch k {{ case 0u: {{ return 1.0; }} default: {{ return 2.0; }} }} }}
         fn first(v: vec4<f32>) -> f32 {{
             for (var k = 0u; k < 4u; k++) {{ if v[k] > 0.0 {{ return v[k]; }} }}
             return 0.0;
         }}
         {body}"
    );
    let module = naga::front::wgsl::parse_str(&text).expect("the test's own WGSL");
    let info = super::validator(false).validate(&module).expect("the test's own WGSL");
    breaches(&module, &info)
}

#[test]
fn each_breach_is_found() {
    let compute = |body: &str| {
        format!(
            "@compute @workgroup_size(1) fn main(@builtin(local_invocation_index) i: u32) {{ {body} }}"
        )
    };
    let component = "a store to a component that is picked at run time";
    let returns = "a return from within a loop of a called function";
    let cases = [
        (compute("var v: vec4<f32>; v[i] = 1.0; out[0] = v;"), vec![component]),
        (compute("var m: mat4x4<f32>; m[i] = vec4(1.0); out[0] = m[0];"), vec![component]),
        (compute("var m: mat4x4<f32>; m[1][i] = 1.0; out[0] = m[1];"), vec![component]),
        (compute("var a: array<vec4<f32>, 4>; a[i].x = 1.0; out[0] = a[0];"), vec![]),
        (compute("out[0][i] = 1.0;"), vec![]),
        (
            compute("for (var k = 0u; k < i; k++) { out[k].x = pick(k); }"),
            vec!["a switch in a function that a loop calls"],
        ),
        (compute("out[0].x = pick(i);"), vec![]),
        (
            compute(
                "for (var k = 0u; k < i; k++) {
                    switch k { case 1u: { continue; } default: { out[k].x = 1.0; } }
                }",
            ),
            vec!["a switch in a loop", "continue in a switch"],
        ),
        (
            "@fragment fn main(@location(0) at: vec2<f32>) -> @location(0) vec4<f32> {
                var sum = vec4(0.0);
                for (var k = 0u; k < 4u; k++) { sum += textureSample(texture, linear, at); }
                return sum;
            }"
            .to_owned(),
            vec!["a gradient in a loop"],
        ),
    ];
    for (body, expected) in cases {
        let found = breaches_of(&body);
        // `first` is in all of them.
        let expected: Vec<_> = std::iter::once(format!("first: {returns}"))
            .chain(expected.iter().map(|what| format!("main: {what}")))
            .collect();
        assert_eq!(found, expected, "{body}");
    }
}
